"""A hint about a scheduler of XLA that does not end when several agents are trained under vmap."""

import os
import warnings
from typing import Any

import jax
import jaxlib
from jax.custom_batching import custom_vmap

FLAG = "--xla_cpu_enable_concurrency_optimized_scheduler=false"
AFFECTED = ("0.10.",)  # versions of jaxlib that it was seen with
FEW_CORES = 4


def needs_flag() -> bool:
    """Return True if this process trains on a few CPU cores with an affected jaxlib, unmended."""
    return (
        jax.default_backend() == "cpu"
        and jaxlib.__version__.startswith(AFFECTED)
        and (os.cpu_count() or 1) <= FEW_CORES
        and FLAG not in os.environ.get("XLA_FLAGS", "")
    )


@custom_vmap
def hint_under_vmap(x: Any) -> Any:
    """Return x, with a warning where `jax.vmap` maps over it on a machine that it may hang on.

    Under vmap the CPU's scheduler of jaxlib 0.10 can wait for ever on two cores. It is not ours to
    set: XLA reads the flag once, when jax first computes.
    """
    return x


@hint_under_vmap.def_vmap
def warn_under_vmap(axis_size: int, in_batched: list[bool], x: Any) -> tuple[Any, bool]:
    """Warn, and return x and whether it is batched.

    Args:
      axis_size: the number of agents.
      in_batched: whether x is batched.
      x: the argument of `hint_under_vmap`.
    """
    if axis_size > 1 and needs_flag():
        warnings.warn(
            f"{axis_size} agents are trained under vmap on {os.cpu_count()} CPU cores: with jaxlib "
            f"{jaxlib.__version__} this may never end. Set XLA_FLAGS={FLAG} before jax starts.",
            stacklevel=2,
        )
    return x, in_batched[0]
