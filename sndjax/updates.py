"""The two halves of an iteration's learning: the PPO epochs, the intrinsic module's pass."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sndjax import ppo
from sndjax.acting import AgentSpec, forward
from sndjax.intrinsic_training import IntrinsicTrainState, train_module
from sndjax.optimizer_steps import (
    ShardRows,
    identity,
    mean_metrics,
    optimizer_step,
    step_with_rows,
)
from sndjax.rollout import make_frame_stacker
from sndjax.statistics import mask_rows
from sndjax.types import Experience, Metrics, Params, TrainState


class PolicyState(NamedTuple):
    """The part of a `TrainState` that learning the policy changes; named as there."""

    policy: Params
    policy_optimizer: optax.OptState


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
    if intrinsic is None:
        return start, {}
    key_order, key_loss = jax.random.split(key)
    rows = jnp.arange(rollout.action.size)
    if intrinsic.shuffle:
        rows = jax.random.permutation(key_order, rows)
    index = rows.reshape(-1, intrinsic.minibatch_size)
    # In order, s_t+1 of most rows is s_t of others; in less than a step of rows, of none.
    apart = intrinsic.shuffle or intrinsic.minibatch_size < rollout.action.shape[1]
    return train_module(intrinsic, start, rollout, index, key_loss, apart, shard_rows)
