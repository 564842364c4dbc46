"""The two halves of an iteration's learning: the PPO epochs, the intrinsic module's pass."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sndjax import ppo
from sndjax.acting import AgentSpec, forward
from sndjax.rollout import gather_transitions, make_frame_stacker, slice_transitions
from sndjax.statistics import mask_rows
from sndjax.types import Experience, Metrics, Params, State, TrainState

ShardRows = Callable[[Any], Any]


class PolicyState(NamedTuple):
    """The part of a `TrainState` that learning the policy changes; named as there."""

    policy: Params
    policy_optimizer: optax.OptState


class IntrinsicTrainState(NamedTuple):
    """The part of a `TrainState` that training the module changes; named as there."""

    intrinsic: Params
    intrinsic_optimizer: optax.OptState
    intrinsic_state: State


def identity(rows: Any) -> Any:
    """Return the rows of a minibatch as they are: all on one device."""
    return rows


def update_policy(
    agent: AgentSpec,
    state: TrainState,
    batch: Experience,
    advantage: Float[Array, "T N"],
    target: Float[Array, "T N K"],
    key: PRNGKeyArray,
    shard_rows: ShardRows = identity,
) -> tuple[PolicyState, Metrics]:
    """Run the PPO epochs: one permutation of the rollout, gone through `epochs` times.

    Args:
      agent: what learns.
      state: before.
      batch: the rollout.
      advantage: of both reward streams together.
      target: of every value head.
      key: of the permutation.
      shard_rows: see `make_train_step`.

    Returns:
      The new policy, and the means of its metrics over minibatches.
    """
    hyper, rollout = agent.ppo, batch.rollout
    stacks = make_frame_stacker(batch, agent.stack)
    optimizer, _ = agent.optimizers()
    rows = advantage.size
    index = jax.random.permutation(key, rows).reshape(-1, hyper.minibatch_size)
    flat = lambda x: x.reshape(rows, *x.shape[2:])
    columns = [flat(x) for x in (rollout.action, batch.log_prob, advantage, target, rollout.valid)]
    valid = columns[-1]

    def loss(
        params: Params,
        stacked: Array,
        action: Array,
        log_prob: Array,
        advantage: Array,
        target: Array,
        valid: Array,
    ) -> tuple[Array, Metrics]:
        logits, value = forward(agent.network, params, stacked)
        return ppo.loss(logits, value, action, log_prob, advantage, target, valid, hyper)

    def minibatch(
        carry: tuple[Params, optax.OptState], index: Int[Array, " B"]
    ) -> tuple[tuple[Params, optax.OptState], Metrics]:
        params, _ = carry
        seen = mask_rows(stacks(index), valid[index])
        rows = shard_rows((seen, *(c[index] for c in columns)))
        (total, metrics), gradient = jax.value_and_grad(loss, has_aux=True)(params, *rows)
        metrics |= {"ppo_loss": total, "grad_norm": optax.tree.norm(gradient)}

        step = partial(optimizer_step, optimizer, gradient)
        return step_with_rows(step, carry, valid[index]), metrics

    (policy, optimizer_state), metrics = lax.scan(
        minibatch, (state.policy, state.policy_optimizer), jnp.tile(index, (hyper.epochs, 1))
    )
    return PolicyState(policy, optimizer_state), mean_metrics(metrics)


def update_intrinsic_module(
    agent: AgentSpec,
    state: TrainState,
    batch: Experience,
    key: PRNGKeyArray,
    shard_rows: ShardRows = identity,
) -> tuple[IntrinsicTrainState, Metrics]:
    """Train the intrinsic module on one pass over the rollout.

    Args:
      agent: what learns.
      state: before.
      batch: the rollout.
      key: of the order of rows and of the module's draws.
      shard_rows: see `make_train_step`.

    Returns:
      The new module, and the means of its metrics over minibatches.
    """
    intrinsic, rollout = agent.intrinsic, batch.rollout
    start = IntrinsicTrainState(state.intrinsic, state.intrinsic_optimizer, state.intrinsic_state)
    if intrinsic is None or not jax.tree.leaves(state.intrinsic):
        return start, {}  # nothing is trained
    module = intrinsic.module
    _, optimizer = agent.optimizers()
    key_order, key_loss = jax.random.split(key)
    rows = jnp.arange(rollout.action.size)
    if intrinsic.shuffle:
        rows = jax.random.permutation(key_order, rows)
    index = rows.reshape(-1, intrinsic.minibatch_size)
    # In order, s_t+1 of most rows is s_t of others; in less than a step of rows, of none.
    apart = intrinsic.shuffle or intrinsic.minibatch_size < rollout.action.shape[1]

    def minibatch(
        carry: IntrinsicTrainState, inputs: tuple[Array, PRNGKeyArray]
    ) -> tuple[IntrinsicTrainState, Metrics]:
        params, _, module_state = carry
        index, key = inputs
        batch = (
            gather_transitions(rollout, index)
            if apart
            else slice_transitions(rollout, index[0], intrinsic.minibatch_size)
        )
        (total, metrics), gradient = jax.value_and_grad(module.loss, has_aux=True)(
            params, module_state, shard_rows(batch), rollout, key
        )
        metrics |= {"module_loss": total, "module_grad_norm": optax.tree.norm(gradient)}

        def step(carry: IntrinsicTrainState) -> IntrinsicTrainState:
            params, optimizer_state, module_state = carry
            trained = (params, optimizer_state)
            params, optimizer_state = optimizer_step(optimizer, gradient, trained)
            return IntrinsicTrainState(params, optimizer_state, module.update(params, module_state))

        return step_with_rows(step, carry, batch.valid), metrics

    keys = jax.random.split(key_loss, index.shape[0])
    learned, metrics = lax.scan(minibatch, start, (index, keys))
    return learned, mean_metrics(metrics)


def optimizer_step(
    optimizer: optax.GradientTransformation,
    gradient: Params,
    carry: tuple[Params, optax.OptState],
) -> tuple[Params, optax.OptState]:
    """Return parameters and optimizer state after a gradient step.

    Args:
      optimizer: what moves them.
      gradient: in the parameters.
      carry: parameters and optimizer state before it.
    """
    params, optimizer_state = carry
    updates, optimizer_state = optimizer.update(gradient, optimizer_state, params)
    return optax.apply_updates(params, updates), optimizer_state


def step_with_rows(step: Callable[[Any], Any], carry: Any, valid: Bool[Array, " B"]) -> Any:
    """Take an optimizer step, or none if no row of its minibatch is valid.

    The gradient is zero then, but Adam would still move the weights, by its momentum.

    Args:
      step: the optimizer step.
      carry: the pytree that it moves.
      valid: the rows that count.
    """
    return lax.cond(jnp.any(valid), step, lambda carry: carry, carry)


def mean_metrics(metrics: dict[str, Array]) -> Metrics:
    """Average every metric over minibatches."""
    return {name: jnp.mean(value) for name, value in metrics.items()}
