"""Reading a rollout: minibatches of rows, stacks of frames, slices of time."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int, PRNGKeyArray, Shaped

from sndjax.checks import check_rollout, check_rows
from sndjax.statistics import broadcast_mask, mask_rows
from sndjax.types import Experience, Rollout, Transition

SLICE = 512  # frames that go through an encoder at once when rewards are read


class FrameStack(NamedTuple):
    """How many of the newest frames the policy sees, and what stands before an episode's first."""

    size: int = 1
    repeat: bool = True  # the first frame again (Atari); False: zeros (Procgen)


def gather_transitions(rollout: Rollout, index: Int[Array, " B"]) -> Transition:
    """Gather the rows `index` of the flattened rollout, row t of environment n being t * N + n.

    Args:
      rollout: T steps of N environments.
      index: B rows, each below T * N. Inside `jax.jit`, where an index cannot be checked, a row
        that does not exist is not valid.

    Raises:
      ValueError: a row does not exist, or the arrays of the rollout do not belong together.
    """
    check_rollout(rollout)
    check_rows(index, rollout.action.size)
    return gather_rows(rollout, index)


def gather_rows(rollout: Rollout, index: Int[Array, " B"]) -> Transition:
    """Gather rows; one that does not exist is not valid. See `gather_transitions`.

    Args:
      rollout: T steps of N environments.
      index: B rows.
    """
    rows, envs = rollout.action.size, rollout.action.shape[1]
    frames = rollout.frames.reshape(-1, *rollout.frames.shape[2:])
    seen = jnp.concatenate([frames[index], frames[index + envs]])
    action, first, done, valid = (x.reshape(-1)[index] for x in rollout[1:])
    there = (index >= 0) & (index < rows)
    return Transition(seen, action, first, done, valid & there)


def slice_transitions(rollout: Rollout, start: Int[Array, ""], rows: int) -> Transition:
    """Slice `rows` consecutive rows from `start` on: as `gather_transitions`, each frame once.

    Args:
      rollout: T steps of N environments.
      start: the first row of the flattened rollout.
      rows: B.

    Raises:
      ValueError: the arrays of the rollout do not belong together.
    """
    check_rollout(rollout)
    envs = rollout.action.shape[1]
    cut = lambda x, size: lax.dynamic_slice_in_dim(x, start, size)
    frames = cut(rollout.frames.reshape(-1, *rollout.frames.shape[2:]), rows + envs)
    return Transition(frames, *(cut(x.reshape(-1), rows) for x in rollout[1:]))


def minibatch_rows(
    key: PRNGKeyArray, steps: int, envs: int, size: int, shuffle: bool, stride: int = 1
) -> Int[Array, "M B"]:
    """Return the rows of every minibatch of a rollout, which are equally large but for one row.

    Args:
      key: of the order.
      steps: T.
      envs: N.
      size: about how many rows a minibatch has.
      shuffle: draw the rows at random; False: the rows of a minibatch follow each other in time.
      stride: the row of time t is stride * t.

    Returns:
      Numbers of rows; where a minibatch has a row less, one that does not exist.

    >>> minibatch_rows(jax.random.key(0), 5, 1, 2, shuffle=False, stride=2)
    Array([[ 0,  2, 10],
           [ 4,  6,  8]], dtype=int32)
    """
    rows = steps * envs
    count = max(1, round(rows / size))
    start = np.arange(count + 1) * rows // count
    place = start[:-1, None] + np.arange(-(-rows // count))
    there = place < start[1:, None]
    order = jax.random.permutation(key, rows) if shuffle else jnp.arange(rows)
    index = order // envs * stride * envs + order % envs
    return jnp.where(there, index[np.where(there, place, 0)], rows * stride)


def zero_invalid_rows(batch: Transition) -> Transition:
    """Replace what the invalid rows of a minibatch hold by zeros.

    A mask on the loss alone would not do: 0 times NaN is NaN in the backward pass.
    """

    valid, frames = batch.valid, batch.frames
    others = (0, frames.shape[0] - valid.shape[0])
    seen = jnp.pad(valid, others) | jnp.pad(valid, others[::-1])  # as s_t, or as s_t+1
    return batch._replace(
        frames=mask_rows(frames, seen),
        action=mask_rows(batch.action, valid),
        first=batch.first & batch.valid,
        done=batch.done & batch.valid,
    )


def zero_reset_rows(batch: Experience) -> Experience:
    """Replace what reset rows hold, frames apart, by zeros."""
    rollout = batch.rollout
    valid = rollout.valid
    zero = lambda x: mask_rows(x, valid)
    return batch._replace(
        rollout=rollout._replace(
            action=zero(rollout.action), first=rollout.first & valid, done=rollout.done & valid
        ),
        reward=zero(batch.reward),
        truncated=batch.truncated & valid,
        log_prob=zero(batch.log_prob),
    )


def push_frame(
    window: Shaped[Array, "S N *frame"],
    frame: Shaped[Array, "N *frame"],
    first: Bool[Array, " N"],
    repeat: bool,
) -> Shaped[Array, "S N *frame"]:
    """Return the next stack, oldest frame first; a new episode's holds nothing of the one before.

    Args:
      window: the stack of every environment.
      frame: the newest frame.
      first: it opens an episode.
      repeat: a new episode's stack repeats its first frame, else zeros stand before it.
    """
    shifted = jnp.concatenate([window[1:], frame[None]])
    older = jnp.broadcast_to(frame, window[1:].shape) if repeat else jnp.zeros_like(window[1:])
    fresh = jnp.concatenate([older, frame[None]])
    return jnp.where(broadcast_mask(first[None], fresh), fresh, shifted)


def stack_to_channels(stacked: Shaped[Array, "S B *frame"]) -> Shaped[Array, "B *stack"]:
    """Join the frames of a stack on the last axis, oldest first, as the policy reads it."""
    return jnp.concatenate(list(stacked), axis=-1)


def steps_since_reset(first: Bool[Array, "T N"], limit: int) -> Int[Array, "T N"]:
    """Count the steps since the episode began, at most `limit`; `limit` if it began earlier."""

    def step(
        count: Int[Array, " N"], first: Bool[Array, " N"]
    ) -> tuple[Int[Array, " N"], Int[Array, " N"]]:
        count = jnp.where(first, 0, jnp.minimum(count + 1, limit))
        return count, count

    return lax.scan(step, jnp.full(first.shape[1:], limit, jnp.int32), first)[1]


def make_frame_stacker(batch: Experience, stack: FrameStack) -> Callable[[Int[Array, " B"]], Array]:
    """Return a function from flat row indices to the stacks that the policy saw there."""
    envs, shape = batch.history.shape[1], batch.history.shape[2:]
    older = stack.size - 1
    frames = jnp.concatenate([batch.history, batch.rollout.frames]).reshape(-1, *shape)
    ages = steps_since_reset(batch.rollout.first, older).reshape(-1)

    def stacks(index: Int[Array, " B"]) -> Array:
        own = ages[index]

        def back(k: int) -> Array:
            seen = jnp.minimum(k, own) if stack.repeat else k
            frame = frames[index + (older - seen) * envs]
            return frame if stack.repeat else mask_rows(frame, k <= own)

        return stack_to_channels(jnp.stack([back(k) for k in range(older, -1, -1)]))

    return stacks


def map_over_time(function: Callable[..., Any], *arrays: Shaped[Array, "T N ..."]) -> Any:
    """Apply a function of batches `[M, ...]` to all of `[T, N, ...]`, some time steps at once.

    Args:
      function: of M rows.
      *arrays: of T steps and N environments.

    Returns:
      The function's result, its leaves `[M, ...]` reshaped to `[T, N, ...]`.
    """
    steps, envs = arrays[0].shape[:2]
    together = max(
        g for g in range(1, steps + 1) if steps % g == 0 and (g == 1 or g * envs <= SLICE)
    )
    cut = lambda x: x.reshape(steps // together, together * envs, *x.shape[2:])
    values = lax.map(lambda parts: function(*parts), tuple(map(cut, arrays)))
    return jax.tree.map(lambda x: x.reshape(steps, envs, *x.shape[2:]), values)
