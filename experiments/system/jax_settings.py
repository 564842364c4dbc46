"""The environment variables of jax, and what is wrong with them if jax cannot start."""

import os
from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any

PLATFORMS = "JAX_PLATFORMS"


def jax_problem(error: BaseException) -> str | None:
    """Return which environment variable keeps jax from starting, and the remedy; None if none does.

    Call this where an unexpected error ends a command.

    Args:
      error: the error that ended the command.
    """
    if isinstance(error, ValueError):  # raised while jax is imported
        return variable_problem(error, os.environ)
    if not isinstance(error, AssertionError | RuntimeError) or not os.environ.get(PLATFORMS):
        return None
    try:
        import jax

        jax.devices()
    except (AssertionError, RuntimeError) as found:
        return platform_problem(os.environ[PLATFORMS], found)
    return None


def variable_problem(error: ValueError, variables: Mapping[str, str]) -> str | None:
    """Return the message about a variable of jax that an error names, or None.

    Args:
      error: the error.
      variables: the environment variables of this process.

    >>> wrong = ValueError("invalid truth value 'maybe' for environment 'JAX_ENABLE_X64'")
    >>> variable_problem(wrong, {"JAX_ENABLE_X64": "maybe"})
    "JAX_ENABLE_X64=maybe: jax does not know this value (invalid truth value 'maybe'); unset it"
    """
    text = str(error)
    for name, value in variables.items():
        if name.startswith("JAX_") and name.lower() in text.lower():
            reason = text.partition(" for ")[0]
            return f"{name}={value}: jax does not know this value ({reason}); unset it"
    return None


def platform_problem(platforms: str, error: BaseException) -> str:
    """Return the message about platforms that jax cannot use.

    Args:
      platforms: the value of JAX_PLATFORMS.
      error: the error of jax, whose text may be empty.
    """
    reason = next(iter(str(error).splitlines()), "").partition(" (set JAX")[0].rstrip(".")
    because = f": {reason}" if reason else ", which has no device or no plugin"
    gpu = {"cuda", "gpu"} & {name.strip().lower() for name in platforms.split(",")}
    install = "; for an NVIDIA GPU: pip install 'jax[cuda12]'" if gpu else ""
    return (
        f"{PLATFORMS}={platforms}: jax cannot use this platform on this machine{because}; "
        f"unset {PLATFORMS}, or set {PLATFORMS}=cpu{install}"
    )


def apply_debug_settings() -> list[str]:
    """Turn off the checks of jax that would stop a run before its own, and return what to say.

    The run itself checks every iteration (on_nan=stop), names the term, keeps a dump and stays
    resumable; jax would end it in the middle of an iteration.

    Returns:
      One line for each variable that is set.
    """
    import jax

    lines = []
    for name in ("jax_debug_nans", "jax_debug_infs"):
        if getattr(jax.config, name):
            jax.config.update(name, False)
            lines.append(
                f"{name.upper()} is set, but not used while training: on_nan=stop checks every "
                "iteration, and sndjax replay finds the line that made a NaN"
            )
    if jit_is_disabled():
        lines.append(
            "warning: JAX_DISABLE_JIT is set: every operation is dispatched by itself, and an "
            "iteration takes minutes even on small tasks, without a sign of life until its end"
        )
    return lines


# An option's value -> jax's name of the precision of products: on a CPU, elsewhere. A CPU computes
# in float32 whatever the name; `sndjax.products` rounds the operands there.
PRECISIONS = {
    "float32": ("float32", "float32"),
    "tf32": ("tensorfloat32", "TF32_TF32_F32"),
    "bf16": ("bfloat16", "BF16_BF16_F32"),
}


def at_precision(name: str | None, function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function whose matrix products have a precision wherever it is traced or called.

    Args:
      name: a key of `PRECISIONS`; None: jax's default, which JAX_DEFAULT_MATMUL_PRECISION sets.
      function: of arrays, to be jitted.
    """
    if name is None:
        return function
    import jax

    on_cpu, elsewhere = PRECISIONS[name]

    @wraps(function)
    def with_precision(*args: Any) -> Any:
        value = on_cpu if jax.default_backend() == "cpu" else elsewhere
        with jax.default_matmul_precision(value):
            return function(*args)

    return with_precision


def jit_is_disabled() -> bool:
    """Return True if JAX_DISABLE_JIT is set."""
    import jax

    name = "jax_disable_jit"  # jax declares no such attribute
    return bool(getattr(jax.config, name))
