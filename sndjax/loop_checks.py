"""Checks of what a training loop of somebody else passes in, in words for its author."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax.dtypes import canonicalize_dtype
from jaxtyping import Array, Bool, Int, Shaped

from sndjax.checks import SIDE, check_actions, check_channels_last


class LoopShapes(NamedTuple):
    """What the arrays of a loop must look like."""

    frame: tuple[int, ...]
    dtype: Any
    num_actions: int

    def check(self, name: str, array: Any, axes: tuple[str, ...], hint: str = "") -> None:
        """Check that an array holds observations like those of the example.

        Args:
          name: of the array.
          array: what was given.
          axes: the names of the axes before those of a frame.
          hint: what to write instead, where the number of axes is wrong.

        Raises:
          ValueError: it has other axes, another frame or another dtype.
        """
        wanted = f"[{', '.join([*axes, *map(str, self.frame)])}]"
        if not hasattr(array, "shape"):
            raise ValueError(f"{name} is a {type(array).__name__}; it must be an array {wanted}")
        shape = tuple(array.shape)
        if len(shape) != len(axes) + len(self.frame):
            raise ValueError(f"{name} has shape {shape}; it must be {wanted}{hint}")
        if shape[len(axes) :] != self.frame:
            raise ValueError(
                f"{name} has shape {shape}; it must be {wanted}, since the example's observations "
                f"have shape {self.frame}"
            )
        if canonicalize_dtype(array.dtype) != canonicalize_dtype(self.dtype):
            raise ValueError(f"{name} is {array.dtype}, and the example is {self.dtype}")


def check_example(example: Any, num_actions: int) -> LoopShapes:
    """Return what arrays must look like, from an example of observations [N, ...].

    Args:
      example: observations of all environments: vectors [N, D], images [N, H, W, C], or grids.
      num_actions: A.

    Raises:
      ValueError: it is no array, has no axis of environments or more axes than an image, or an
        image has no axis of channels or has it first; or A is not positive.
    """
    if not hasattr(example, "shape"):
        raise ValueError(
            f"example is a {type(example).__name__}; it must be one array [N, ...]: concatenate "
            "the parts of an observation into a vector"
        )
    if example.ndim < 2:
        raise ValueError(
            f"example has shape {example.shape}; it must be [N, ...], the observations of N "
            "environments; for a single environment write obs[None], for one number of each "
            "write obs[:, None]"
        )
    frame = tuple(example.shape[1:])
    check_channels_last(frame)
    if len(frame) > 3:
        raise ValueError(
            f"observations of shape {frame} have more axes than an image [H, W, C]; join stacked "
            "frames on the last axis, or pass the newest one"
        )
    if len(frame) == 2 and min(frame) >= SIDE:
        raise ValueError(
            f"observations of shape {frame} are images without an axis of channels; write "
            "obs[..., None]"
        )
    if num_actions < 1:
        raise ValueError(f"num_actions={num_actions}; it must be 1 or more")
    return LoopShapes(frame, example.dtype, num_actions)


def check_steps(
    shapes: LoopShapes,
    num_envs: int,
    obs: Shaped[Array, "T N *frame"],
    action: Int[Array, "T N"],
    next_obs: Shaped[Array, "T N *frame"] | None,
    done: Any,
    last_obs: Shaped[Array, "N *frame"] | None,
) -> Bool[Array, "T N"]:
    """Check the arrays of T steps, and return `done` as booleans.

    Args:
      shapes: what they must look like.
      num_envs: N, of the state.
      obs: what the policy saw.
      action: what it did.
      next_obs: the true next observation.
      done: the episode ended.
      last_obs: in place of `next_obs`.

    Raises:
      ValueError: one does not fit, in words.
    """
    one = "; for one step write obs[None], action[None], next_obs[None], done[None]"
    shapes.check("obs", obs, ("T", "N"), one)
    rows = tuple(obs.shape[:2])
    if rows[1] != num_envs:
        raise ValueError(
            f"obs has {rows[1]} environments, and init got {num_envs}; the axes are [T, N, ...], "
            "time first"
        )
    if (next_obs is None) == (last_obs is None):
        raise ValueError(
            "give either next_obs [T, N, ...], the true next observations, or last_obs [N, ...], "
            "what the last step returned"
        )
    if next_obs is not None:
        shapes.check("next_obs", next_obs, ("T", "N"))
        check_leading_axes("next_obs", next_obs.shape[:2], rows)
    if last_obs is not None:
        shapes.check("last_obs", last_obs, ("N",))
        check_leading_axes("last_obs", last_obs.shape[:1], rows[1:])
    check_action(shapes, action, rows)
    check_flags("done", done, rows)
    return jnp.asarray(done).astype(bool)


def check_batch(
    shapes: LoopShapes,
    obs: Shaped[Array, "B *frame"],
    action: Int[Array, " B"],
    next_obs: Shaped[Array, "B *frame"],
    valid: Shaped[Array, " B"] | None,
) -> Bool[Array, " B"]:
    """Check the arrays of B transitions, and return `valid` as booleans.

    Args:
      shapes: what they must look like.
      obs: what the policy saw.
      action: what it did.
      next_obs: the next observation.
      valid: the rows that count.

    Raises:
      ValueError: one does not fit, in words.
    """
    shapes.check("obs", obs, ("B",), "; for [T, N, ...] call step")
    rows = tuple(obs.shape[:1])
    shapes.check("next_obs", next_obs, ("B",))
    check_leading_axes("next_obs", next_obs.shape[:1], rows)
    check_action(shapes, action, rows)
    if valid is None:
        return jnp.ones(rows, bool)
    check_flags("valid", valid, rows)
    return jnp.asarray(valid).astype(bool)


def check_action(shapes: LoopShapes, action: Any, rows: tuple[int, ...]) -> None:
    """Check the actions of a loop.

    Args:
      shapes: for the number of actions.
      action: 0 to A - 1.
      rows: the shape that they must have.

    Raises:
      ValueError: they have another shape, are no integers, or one is not below A (where its value
        is known).
    """
    continuous = hasattr(action, "shape") and tuple(action.shape[:-1]) == rows
    if continuous and len(rows) > 0 and action.shape[-1] != 1:
        raise ValueError(
            f"action has shape {tuple(action.shape)}: vectors of continuous actions are not "
            f"supported; actions are integers of shape {rows}"
        )
    check_flags("action", action, rows)
    if not jnp.issubdtype(action.dtype, jnp.integer):
        raise ValueError(
            f"action is {action.dtype}; actions are integers, 0 to {shapes.num_actions - 1}"
        )
    check_actions(action, jnp.ones(rows, bool), shapes.num_actions)


def check_flags(name: str, array: Any, rows: tuple[int, ...]) -> None:
    """Check that there is an array with one entry for each row.

    Args:
      name: of the array.
      array: what was given.
      rows: the shape that it must have.

    Raises:
      ValueError: it is no array, or has another shape.
    """
    if not hasattr(array, "shape"):
        raise ValueError(f"{name} is {array!r}; it must be an array of shape {rows}")
    check_leading_axes(name, tuple(array.shape), rows)


def check_leading_axes(name: str, shape: tuple[int, ...], rows: tuple[int, ...]) -> None:
    """Check that the leading axes of an array are those of `obs`.

    Args:
      name: of the array.
      shape: its leading axes.
      rows: those of `obs`.

    Raises:
      ValueError: they differ.
    """
    if tuple(shape) != rows:
        raise ValueError(f"{name} has {tuple(shape)} rows, and obs has {rows}")
