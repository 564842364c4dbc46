"""Two independent computations at the same time, on two devices that run one program."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax


def run_side_by_side(
    axis: str, first: Callable[[], Any], second: Callable[[], Any]
) -> tuple[Any, Any]:
    """Compute `first()` on one device and `second()` on another, and give both results to both.

    The results are those of one after the other, up to rounding: XLA may fuse them otherwise.

    Args:
      axis: the name of a mesh axis of two devices; the call is under `jax.shard_map` over it, with
        the same inputs on both.
      first: a function that returns a pytree of arrays.
      second: another one; neither holds a collective operation.

    Returns:
      Both results.
    """
    shapes = jax.eval_shape(lambda: (first(), second()))
    zeros = lambda shape: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape)
    one, other = lax.cond(
        lax.axis_index(axis) == 0,
        lambda: (first(), zeros(shapes[1])),
        lambda: (zeros(shapes[0]), second()),
    )
    return take_from(0, axis, one), take_from(1, axis, other)


def take_from(device: int, axis: str, tree: Any) -> Any:
    """Return what a device has, on all devices of the axis: one exchange for each dtype.

    Args:
      device: its index on the axis.
      axis: the name of the mesh axis.
      tree: a pytree of arrays, different on each device.
    """
    leaves, structure = jax.tree.flatten(tree)
    found = list(leaves)
    for dtype in dict.fromkeys(leaf.dtype for leaf in leaves):
        own = [i for i, leaf in enumerate(leaves) if leaf.dtype == dtype]
        joined = jnp.concatenate([leaves[i].reshape(-1) for i in own])
        theirs, start = lax.all_gather(joined, axis)[device], 0
        for i in own:
            size = leaves[i].size
            found[i] = theirs[start : start + size].reshape(leaves[i].shape)
            start += size
    return jax.tree.unflatten(structure, found)
