"""The two halves of an iteration's learning: the PPO epochs, the intrinsic module's pass."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sndjax import ppo
from sndjax.acting import AgentSpec, forward, unroll
from sndjax.intrinsic_training import IntrinsicTrainState, module_part, module_pass
from sndjax.optimizer_steps import (
    ShardRows,
    annealed_rate,
    identity,
    mean_metrics,
    optimizer_step,
    step_with_rows,
)
from sndjax.passes import Pass, PassState, run_pass
from sndjax.policy_minibatches import PolicyRows, Recall, make_draw, minibatch_orders
from sndjax.types import Experience, Metrics, Params, TrainState


class PolicyState(NamedTuple):
    """The part of a `TrainState` that learning the policy changes; named as there."""

    policy: Params
    policy_optimizer: optax.OptState


# Parameters and optimizer state, and whether further epochs are skipped; None: they never are.
Trained = tuple[tuple[Params, optax.OptState], Any]


def policy_loss(
    agent: AgentSpec, params: Params, rows: PolicyRows, recall: Recall | None
) -> tuple[Float[Array, ""], Metrics]:
    """Compute the loss of one minibatch, see `ppo.loss`.

    Args:
      agent: what learns.
      params: the policy's weights.
      rows: the minibatch; of a recurrent policy in time order, row t of sequence n at t * N + n.
      recall: of a recurrent policy.
    """
    if recall is None:
        logits, value = forward(agent.network, params, rows.stacked)
    else:
        logits, value, _ = unroll(agent.network, params, rows.stacked, *recall)
    return ppo.loss(
        logits=logits,
        value=value,
        action=rows.action,
        old_log_prob=rows.log_prob,
        advantage=rows.advantage,
        target=rows.target,
        valid=rows.valid,
        hyper=agent.ppo,
        old_value=rows.old_value,
    )


def policy_pass(
    agent: AgentSpec,
    state: TrainState,
    batch: Experience,
    advantage: Float[Array, "T N"],
    target: Float[Array, "T N K"],
    key: PRNGKeyArray,
    shard_rows: ShardRows = identity,
) -> Pass:
    """Return the optimizer steps of the PPO epochs over a rollout.

    With `target_kl` no further epoch is run after one whose last minibatch had a larger KL
    estimate: the steps are skipped, and their losses still enter the means.

    Args:
      agent: what learns.
      state: before.
      batch: the rollout.
      advantage: of both reward streams together.
      target: of every value head.
      key: of the permutations.
      shard_rows: see `make_train_step`; a recurrent policy's minibatches stay whole.
    """
    hyper = agent.ppo
    optimizer, _ = agent.optimizers()
    rate = annealed_rate(hyper.anneal_iterations, state.iteration)
    draw = make_draw(agent, batch, advantage, target, shard_rows)
    valid = batch.rollout.valid.reshape(-1)

    def minibatch(
        carry: Trained, inputs: tuple[Int[Array, " B"], Bool[Array, ""] | None]
    ) -> tuple[Trained, Metrics]:
        (trained, stopped), (index, last) = carry, inputs
        rows, recall = draw(index)
        loss = partial(policy_loss, agent)
        (total, metrics), gradient = jax.value_and_grad(loss, has_aux=True)(
            trained[0], rows, recall
        )
        metrics |= {"ppo_loss": total, "grad_norm": optax.tree.norm(gradient)}
        step = partial(optimizer_step, optimizer, gradient, rate)
        counted = valid[index]
        if hyper.target_kl is not None:
            metrics |= {"epochs_run": jnp.where(stopped, 0.0, float(hyper.epochs))}
            counted &= ~stopped
            stopped |= last & (metrics["kl"] > hyper.target_kl)
        return (step_with_rows(step, trained, counted), stopped), metrics

    index = minibatch_orders(agent, batch, key)
    epochs, each, size = index.shape
    index = index.reshape(-1, size)
    start = (state.policy, state.policy_optimizer)
    if hyper.target_kl is None:
        return Pass(minibatch, (start, None), (index, None))
    last = jnp.tile(jnp.arange(each) == each - 1, epochs)
    return Pass(minibatch, (start, jnp.zeros((), bool)), (index, last))


def finish_policy_pass(
    agent: AgentSpec, done: PassState, iteration: Int[Array, ""]
) -> tuple[PolicyState, Metrics]:
    """Return the new policy, and the means of its metrics over minibatches.

    Args:
      agent: what learns.
      done: its pass, all steps taken.
      iteration: how many iterations were run before.
    """
    trained, _ = done.carry
    metrics = mean_metrics(done.metrics)
    rate = annealed_rate(agent.ppo.anneal_iterations, iteration)
    if rate is not None:
        metrics |= {"learning_rate": rate * agent.ppo.learning_rate}
    return PolicyState(*trained), metrics


def update_policy(
    agent: AgentSpec,
    state: TrainState,
    batch: Experience,
    advantage: Float[Array, "T N"],
    target: Float[Array, "T N K"],
    key: PRNGKeyArray,
    shard_rows: ShardRows = identity,
) -> tuple[PolicyState, Metrics]:
    """Run the PPO epochs over the rollout. See `policy_pass`.

    Args:
      agent: what learns.
      state: before.
      batch: the rollout.
      advantage: of both reward streams together.
      target: of every value head.
      key: of the permutations.
      shard_rows: see `make_train_step`.

    Returns:
      The new policy, and the means of its metrics over minibatches.
    """
    done = run_pass(policy_pass(agent, state, batch, advantage, target, key, shard_rows))
    return finish_policy_pass(agent, done, state.iteration)


def intrinsic_pass(
    agent: AgentSpec,
    state: TrainState,
    batch: Experience,
    key: PRNGKeyArray,
    shard_rows: ShardRows = identity,
) -> Pass:
    """Return the optimizer steps of the intrinsic module: `epochs` passes over the rollout.

    Args:
      agent: what learns.
      state: before.
      batch: the rollout.
      key: of the order of rows and of the module's draws.
      shard_rows: see `make_train_step`.
    """
    intrinsic, rollout = agent.intrinsic, batch.rollout
    assert intrinsic is not None
    key_order, key_loss = jax.random.split(key)
    rows = jnp.arange(rollout.action.size)
    later = jax.random.split(jax.random.fold_in(key, 2), intrinsic.epochs - 1)
    orders = [key_order, *later]  # 0 and 1 are the halves of the key
    passes = [jax.random.permutation(k, rows) if intrinsic.shuffle else rows for k in orders]
    index = jnp.concatenate(passes).reshape(-1, intrinsic.minibatch_size)
    # In order, s_t+1 of most rows is s_t of others; in less than a step of rows, of none.
    apart = intrinsic.shuffle or intrinsic.minibatch_size < rollout.action.shape[1]
    rate = annealed_rate(intrinsic.anneal_iterations, state.iteration)
    return module_pass(
        intrinsic, module_part(state), rollout, index, key_loss, apart, shard_rows, rate
    )


def update_intrinsic_module(
    agent: AgentSpec,
    state: TrainState,
    batch: Experience,
    key: PRNGKeyArray,
    shard_rows: ShardRows = identity,
) -> tuple[IntrinsicTrainState, Metrics]:
    """Train the intrinsic module on `epochs` passes over the rollout.

    Args:
      agent: what learns.
      state: before.
      batch: the rollout.
      key: of the order of rows and of the module's draws.
      shard_rows: see `make_train_step`.

    Returns:
      The new module, and the means of its metrics over minibatches.
    """
    if not jax.tree.leaves(state.intrinsic):
        return module_part(state), {}
    done = run_pass(intrinsic_pass(agent, state, batch, key, shard_rows))
    return done.carry, mean_metrics(done.metrics)
