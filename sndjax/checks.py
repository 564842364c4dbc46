"""Checks of what a caller passes in, with errors that say what was given and what is wanted.

Shapes are checked always; values only where they are known, outside of `jax.jit`.
"""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Bool, Int, Shaped

from sndjax.types import Rollout

SIDE = 32  # pixels, of an image; a shorter first axis beside two such sides is one of channels
BRIGHT = 16.0  # a float image that holds more is not in [0, 1], and not standardised either


def check_rollout(rollout: Rollout, num_actions: int | None = None) -> None:
    """Check that the arrays of a rollout belong together.

    Shapes are always checked; values only where they are known, outside of `jax.jit`.

    Args:
      rollout: T steps of N environments.
      num_actions: A; None: actions are not checked.

    Raises:
      ValueError: a shape is another than the fields of `Rollout` say, or an action is not below A.
    """
    rows = rollout.valid.shape
    if len(rows) != 2:
        raise ValueError(f"rollout.valid has shape {rows}; it must be [T, N]")
    for name in ("action", "first", "done"):
        shape = getattr(rollout, name).shape
        if shape != rows:
            raise ValueError(f"rollout.{name} has shape {shape}; rollout.valid has {rows}")
    wanted = (rows[0] + 1, rows[1])
    if rollout.frames.shape[:2] != wanted:
        raise ValueError(
            f"rollout.frames has shape {rollout.frames.shape}; for T = {rows[0]} steps of N = "
            f"{rows[1]} environments it must be [T + 1, N, ...], one frame more than steps"
        )
    if num_actions is not None:
        check_actions(rollout.action, rollout.valid, num_actions)


def check_actions(
    action: Int[Array, "*rows"], valid: Bool[Array, "*rows"], num_actions: int
) -> None:
    """Check that the actions of the valid rows are below A, where their values are known.

    Args:
      action: the actions.
      valid: the rows that count.
      num_actions: A.

    Raises:
      ValueError: an action is negative, or not below A.
    """
    if not isinstance(action, jax.core.Tracer) and not isinstance(valid, jax.core.Tracer):
        check_below("action", np.asarray(action)[np.asarray(valid)], num_actions)


def check_rows(index: Int[Array, " B"], rows: int) -> None:
    """Check that the row numbers of a minibatch are below T * N, where their values are known.

    Args:
      index: the row numbers.
      rows: T * N.

    Raises:
      ValueError: a row does not exist.
    """
    if not isinstance(index, jax.core.Tracer):
        check_below("row", np.asarray(index), rows)


def check_below(what: str, numbers: np.ndarray, limit: int) -> None:
    """Check that numbers are 0 or more and below a limit.

    Args:
      what: the kind of thing that is numbered.
      numbers: an array of integers.
      limit: the number of things.

    Raises:
      ValueError: a number is outside; the message names the first.
    """
    wrong = numbers[(numbers < 0) | (numbers >= limit)]
    if wrong.size:
        raise ValueError(f"{what} {wrong[0]} does not exist: there are {limit}, 0 to {limit - 1}")


def check_choice(name: str, value: Any, words: tuple[str, ...]) -> None:
    """Check that an option is one of its words.

    Args:
      name: of the option.
      value: what was given.
      words: what it may be.

    Raises:
      ValueError: it is none of them.
    """
    if value not in words:
        raise ValueError(f"{name}={value!r}; it is one of {', '.join(words)}")


def check_channels_last(shape: tuple[int, ...]) -> None:
    """Check that a frame of three axes does not have its channels first.

    Args:
      shape: of a frame.

    Raises:
      ValueError: it has.
    """
    if len(shape) == 3 and shape[0] < SIDE and min(shape[1:]) >= SIDE:
        raise ValueError(f"frames of shape {shape} have their channels first; they must be last")


def check_images(frames: Shaped[Array, "B *frame"]) -> None:
    """Check that a batch of frames can be the input of convolutions: [B, H, W, C].

    Args:
      frames: the batch.

    Raises:
      ValueError: frames are vectors, their channels come first, or (outside of `jax.jit`) they are
        floats far above 1.
    """
    shape = frames.shape[1:]
    if len(shape) != 3:
        raise ValueError(
            f"frames of shape {shape} are no images [H, W, C]; for vectors take size=sndjax.VECTOR"
        )
    check_channels_last(shape)
    floats = np.issubdtype(frames.dtype, np.floating)
    if floats and not isinstance(frames, jax.core.Tracer) and np.abs(frames).max() > BRIGHT:
        raise ValueError(
            f"images of {frames.dtype} hold {np.abs(frames).max():g}: pixels of 0 to 255 must be "
            "integers, which are read as x / 255, and floats must be in [0, 1]"
        )
