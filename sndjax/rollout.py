"""Reading a rollout: minibatches of rows, stacks of frames, slices of time."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int, Shaped

from sndjax.statistics import expand
from sndjax.types import Experience, Rollout, Transition

SLICE = 512  # frames that go through an encoder at once when rewards are read


class Stack(NamedTuple):
    """How many of the newest frames the policy sees, and what stands before an episode's first."""

    size: int = 1
    repeat: bool = True  # the first frame again (Atari); False: zeros (Procgen)


def transitions(rollout: Rollout, index: Int[Array, " B"]) -> Transition:
    """The rows `index` of the flattened rollout, row t of environment n being t * N + n."""
    envs = rollout.action.shape[1]
    frames = rollout.frames.reshape(-1, *rollout.frames.shape[2:])
    seen = jnp.concatenate([frames[index], frames[index + envs]])
    return Transition(seen, *(x.reshape(-1)[index] for x in rollout[1:]))


def consecutive(rollout: Rollout, start: Int[Array, ""], rows: int) -> Transition:
    """The `rows` rows from `start` on: the same as `transitions`, each frame there once."""
    envs = rollout.action.shape[1]
    cut = lambda x, size: lax.dynamic_slice_in_dim(x, start, size)
    frames = cut(rollout.frames.reshape(-1, *rollout.frames.shape[2:]), rows + envs)
    return Transition(frames, *(cut(x.reshape(-1), rows) for x in rollout[1:]))


def without_invalid(batch: Transition) -> Transition:
    """The same minibatch with the contents of its invalid rows replaced by zeros.

    A mask on the loss alone would not do: 0 times NaN is NaN in the backward pass.
    """

    valid, frames = batch.valid, batch.frames
    others = (0, frames.shape[0] - valid.shape[0])
    seen = jnp.pad(valid, others) | jnp.pad(valid, others[::-1])  # as s_t, or as s_t+1
    return batch._replace(
        frames=jnp.where(expand(seen, frames), frames, jnp.zeros_like(frames)),
        action=jnp.where(valid, batch.action, 0),
        first=batch.first & batch.valid,
        done=batch.done & batch.valid,
    )


def push(
    window: Shaped[Array, "S N *frame"],
    frame: Shaped[Array, "N *frame"],
    first: Bool[Array, " N"],
    repeat: bool,
) -> Shaped[Array, "S N *frame"]:
    """The next stack, oldest frame first; a new episode's holds nothing of the one before."""
    shifted = jnp.concatenate([window[1:], frame[None]])
    older = jnp.broadcast_to(frame, window[1:].shape) if repeat else jnp.zeros_like(window[1:])
    fresh = jnp.concatenate([older, frame[None]])
    return jnp.where(expand(first[None], fresh), fresh, shifted)


def channels(stacked: Shaped[Array, "S B *frame"]) -> Shaped[Array, "B *stack"]:
    """A stack as the policy reads it: its frames side by side on the last axis, oldest first."""
    return jnp.concatenate(list(stacked), axis=-1)


def age(first: Bool[Array, "T N"], limit: int) -> Int[Array, "T N"]:
    """Steps since the episode began, at most `limit`; `limit` too where it began before."""

    def step(count, first):
        count = jnp.where(first, 0, jnp.minimum(count + 1, limit))
        return count, count

    return lax.scan(step, jnp.full(first.shape[1:], limit, jnp.int32), first)[1]


def stacker(batch: Experience, stack: Stack) -> Callable[[Int[Array, " B"]], Array]:
    """A function from flat row indices to the stacks the policy saw there."""
    envs, shape = batch.history.shape[1], batch.history.shape[2:]
    older = stack.size - 1
    frames = jnp.concatenate([batch.history, batch.rollout.frames]).reshape(-1, *shape)
    ages = age(batch.rollout.first, older).reshape(-1)

    def stacks(index):
        own = ages[index]

        def back(k):
            seen = jnp.minimum(k, own) if stack.repeat else k
            frame = frames[index + (older - seen) * envs]
            return (
                frame
                if stack.repeat
                else jnp.where(expand(k <= own, frame), frame, jnp.zeros_like(frame))
            )

        return channels(jnp.stack([back(k) for k in range(older, -1, -1)]))

    return stacks


def map_steps(function: Callable[..., Any], *arrays: Shaped[Array, "T N ..."]) -> Any:
    """Apply a function of batches `[M, ...]` to all of `[T, N, ...]`, some time steps at once.

    The result's leaves, `[M, ...]` of the function, become `[T, N, ...]`.
    """
    steps, envs = arrays[0].shape[:2]
    together = max(
        g for g in range(1, steps + 1) if steps % g == 0 and (g == 1 or g * envs <= SLICE)
    )
    cut = lambda x: x.reshape(steps // together, together * envs, *x.shape[2:])
    values = lax.map(lambda parts: function(*parts), tuple(map(cut, arrays)))
    return jax.tree.map(lambda x: x.reshape(steps, envs, *x.shape[2:]), values)
