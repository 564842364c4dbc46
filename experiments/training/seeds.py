"""Functions of one seed, mapped over all seeds of a run."""

from collections.abc import Callable
from typing import Any

import jax


def map_over_seeds(
    function: Callable[..., Any], seeds: int, shared: int = 0, axis: str | None = None
) -> Callable[..., Any]:
    """Return a function that applies `function` to every seed, leaves [S, ...].

    For a single seed there is no vmap; the axis is removed and added again, because a batch axis
    of one costs time on a CPU.

    Args:
      function: a function of one seed.
      seeds: S, the number of seeds.
      shared: the number of its last arguments that are the same for all seeds.
      axis: on several devices, the name of the mesh's axis of seeds.
    """
    if seeds > 1:
        in_axes = lambda args: [0] * (len(args) - shared) + [None] * shared
        return lambda *args: jax.vmap(function, in_axes(args), spmd_axis_name=axis)(*args)

    def single(*args: Any) -> Any:
        own, same = args[: len(args) - shared], args[len(args) - shared :]
        result = function(*jax.tree.map(lambda x: x[0], own), *same)
        return jax.tree.map(lambda x: x[None], result)

    return single
