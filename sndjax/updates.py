"""The two halves of an iteration's learning: the PPO epochs, the intrinsic module's pass."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from sndjax import ppo
from sndjax.acting import AgentSpec, forward, unroll
from sndjax.intrinsic_training import IntrinsicTrainState, train_module
from sndjax.optimizer_steps import (
    ShardRows,
    annealed_rate,
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


class PolicyRows(NamedTuple):
    """What the policy's loss reads of each row of a minibatch.

    Attributes:
      stacked: the frames that the policy saw.
      action: what it did.
      log_prob: of that, when it was done.
      advantage: of both reward streams together.
      target: of every value head.
      valid: the rows that count.
      old_value: of the critic then; None where nothing reads it.
    """

    stacked: Shaped[Array, "B *stack"]
    action: Int[Array, " B"]
    log_prob: Float[Array, " B"]
    advantage: Float[Array, " B"]
    target: Float[Array, "B K"]
    valid: Bool[Array, " B"]
    old_value: Float[Array, "B K"] | None


# Parameters and optimizer state, and whether further epochs are skipped; None: they never are.
Trained = tuple[tuple[Params, optax.OptState], Any]


class Recall(NamedTuple):
    """Where the sequences of a minibatch begin, for a recurrent policy."""

    hidden: Float[Array, "n d"]  # the recurrent state before the rollout
    first: Bool[Array, "T n"]  # where episodes open


def minibatch_orders(
    agent: AgentSpec, batch: Experience, key: PRNGKeyArray
) -> Int[Array, "epochs M B"]:
    """Return the rows of every minibatch of every epoch.

    One permutation serves all epochs, or each has its own. A recurrent policy gets whole sequences:
    its minibatch is all T steps of some environments, in time order.

    Args:
      agent: what learns.
      batch: the rollout.
      key: of the permutations.

    Raises:
      ValueError: the minibatches of a recurrent policy are not whole sequences.
    """
    hyper, (steps, envs) = agent.ppo, batch.rollout.action.shape
    together = 1
    if batch.hidden is not None:
        together = steps
        if hyper.minibatch_size % steps or envs % (hyper.minibatch_size // steps):
            raise ValueError(
                f"minibatch_size={hyper.minibatch_size}: a recurrent policy learns from whole "
                f"sequences of {steps} steps; it must be {steps} times a divisor of {envs}"
            )
    count = steps * envs // together

    def order(key: PRNGKeyArray) -> Int[Array, "M B"]:
        drawn = jax.random.permutation(key, count)
        if together == 1:
            return drawn.reshape(-1, hyper.minibatch_size)
        chosen = drawn.reshape(-1, 1, hyper.minibatch_size // steps)
        rows = jnp.arange(steps)[None, :, None] * envs + chosen
        return rows.reshape(rows.shape[0], -1)

    if hyper.shuffle_each_epoch:
        return jnp.stack([order(key) for key in jax.random.split(key, hyper.epochs)])
    return jnp.tile(order(key)[None], (hyper.epochs, 1, 1))


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


def make_draw(
    agent: AgentSpec,
    batch: Experience,
    advantage: Float[Array, "T N"],
    target: Float[Array, "T N K"],
    shard_rows: ShardRows,
) -> Callable[[Int[Array, " B"]], tuple[PolicyRows, Recall | None]]:
    """Return a function that gathers the rows of a minibatch.

    Args:
      agent: what learns.
      batch: the rollout.
      advantage: of both reward streams together.
      target: of every value head.
      shard_rows: see `make_train_step`.
    """
    rollout, envs = batch.rollout, batch.rollout.action.shape[1]
    stacks = make_frame_stacker(batch, agent.stack)
    flat = lambda x: x.reshape(advantage.size, *x.shape[2:])
    valid = flat(rollout.valid)
    columns = {
        "action": flat(rollout.action),
        "log_prob": flat(batch.log_prob),
        "advantage": flat(advantage),
        "target": flat(target),
        "valid": valid,
        "old_value": None if agent.ppo.value_clip is None else flat(batch.value[:-1]),
    }

    def draw(index: Int[Array, " B"]) -> tuple[PolicyRows, Recall | None]:
        seen = mask_rows(stacks(index), valid[index])
        rows = PolicyRows(seen, **jax.tree.map(lambda x: x[index], columns))
        if batch.hidden is None:
            return shard_rows(rows), None
        chosen = index[: index.shape[0] // rollout.first.shape[0]]  # the rows of step 0
        return rows, Recall(batch.hidden[chosen % envs], rollout.first[:, chosen % envs])

    return draw


def update_policy(
    agent: AgentSpec,
    state: TrainState,
    batch: Experience,
    advantage: Float[Array, "T N"],
    target: Float[Array, "T N K"],
    key: PRNGKeyArray,
    shard_rows: ShardRows = identity,
) -> tuple[PolicyState, Metrics]:
    """Run the PPO epochs over the rollout.

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

    Returns:
      The new policy, and the means of its metrics over minibatches.
    """
    hyper = agent.ppo
    optimizer, _ = agent.optimizers()
    rate = annealed_rate(hyper.anneal_iterations, state.iteration)
    draw = make_draw(agent, batch, advantage, target, shard_rows)
    valid = batch.rollout.valid.reshape(-1)

    def minibatch(carry: Trained, index: Int[Array, " B"]) -> tuple[Trained, Metrics]:
        trained, stopped = carry
        rows, recall = draw(index)
        loss = partial(policy_loss, agent)
        (total, metrics), gradient = jax.value_and_grad(loss, has_aux=True)(
            trained[0], rows, recall
        )
        metrics |= {"ppo_loss": total, "grad_norm": optax.tree.norm(gradient)}
        step = partial(optimizer_step, optimizer, gradient, rate)
        counted = valid[index] if stopped is None else valid[index] & ~stopped
        return (step_with_rows(step, trained, counted), stopped), metrics

    def epoch(
        target_kl: float, carry: Trained, index: Int[Array, "M B"]
    ) -> tuple[Trained, dict[str, Array]]:
        after, metrics = lax.scan(minibatch, carry, index)
        metrics |= {"epochs_run": jnp.where(carry[1], 0.0, float(hyper.epochs))}
        return (after[0], after[1] | (metrics["kl"][-1] > target_kl)), metrics

    start = (state.policy, state.policy_optimizer)
    index = minibatch_orders(agent, batch, key)
    if hyper.target_kl is None:
        index = index.reshape(-1, index.shape[-1])
        (trained, _), metrics = lax.scan(minibatch, (start, None), index)
    else:
        (trained, _), metrics = lax.scan(
            partial(epoch, hyper.target_kl), (start, jnp.zeros((), bool)), index
        )
    if rate is not None:
        metrics |= {"learning_rate": rate * hyper.learning_rate}
    return PolicyState(*trained), mean_metrics(metrics)


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
    intrinsic, rollout = agent.intrinsic, batch.rollout
    start = IntrinsicTrainState(state.intrinsic, state.intrinsic_optimizer, state.intrinsic_state)
    if intrinsic is None:
        return start, {}
    key_order, key_loss = jax.random.split(key)
    rows = jnp.arange(rollout.action.size)
    later = jax.random.split(jax.random.fold_in(key, 2), intrinsic.epochs - 1)
    orders = [key_order, *later]  # 0 and 1 are the halves of the key
    passes = [jax.random.permutation(k, rows) if intrinsic.shuffle else rows for k in orders]
    index = jnp.concatenate(passes).reshape(-1, intrinsic.minibatch_size)
    # In order, s_t+1 of most rows is s_t of others; in less than a step of rows, of none.
    apart = intrinsic.shuffle or intrinsic.minibatch_size < rollout.action.shape[1]
    rate = annealed_rate(intrinsic.anneal_iterations, state.iteration)
    return train_module(intrinsic, start, rollout, index, key_loss, apart, shard_rows, rate)
