"""The minibatches of the policy: which rows they hold, what its loss reads of them."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from sndjax.acting import AgentSpec
from sndjax.optimizer_steps import ShardRows
from sndjax.rollout import make_frame_stacker
from sndjax.statistics import mask_rows
from sndjax.types import Experience


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
