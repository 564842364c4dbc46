"""Settings of the process before and after jax starts, and the exit of a script."""

import ctypes
import os
import sys
import warnings
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from .errors import TaskError, print_error

# Schedules an update's operations for low memory on a CPU: a third less
# (1.84 GB of temporaries become 1.21 GB for snd_std on Atari). XLA aborts on an unknown
# flag, so the flag is set only for the versions that it was tested with.
MEMORY_SCHEDULE = "--xla_cpu_enable_concurrency_optimized_scheduler=false"
TRIED_VERSIONS = ("0.10.",)


def configure_xla() -> None:
    """Set XLA's flags and silence known warnings.

    XLA reads the flags once, when jax first computes.
    """
    warnings.filterwarnings("ignore", message=".*Box (low|high)'s precision.*")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "1")
    flags = os.environ.get("XLA_FLAGS", "")
    if version("jaxlib").startswith(TRIED_VERSIONS) and MEMORY_SCHEDULE not in flags:
        os.environ["XLA_FLAGS"] = f"{MEMORY_SCHEDULE} {flags}".strip()


def return_freed_memory() -> None:
    """Give the memory freed after start-up and compilation back to the system (glibc keeps it)."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def enable_compilation_cache() -> None:
    """Turn on jax's compilation cache, so that the next run of the same sizes starts fast."""
    import jax  # not before `configure_xla`

    default = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "sndjax" / "jax"
    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_compilation_cache_dir", str(default))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def rss_mb() -> float:
    """Return the resident memory of this process in MB."""
    import psutil  # of the extra `lab`

    return psutil.Process().memory_info().rss / 1e6


def available_memory() -> int:
    """Return the memory in bytes that new data can take."""
    import psutil

    return psutil.virtual_memory().available


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    # macOS has no affinity.
    known = hasattr(os, "sched_getaffinity")
    return len(os.sched_getaffinity(0)) if known else os.cpu_count() or 1


def run_script(main: Callable[[list[str]], int]) -> None:
    """Run a command with the arguments of this process, and exit with its status.

    If the reader of the output closes the pipe, the command ends without a traceback. With the
    status of a signal (128 + its number) the process exits at once, because an interrupted update
    may still compute for minutes.
    """
    try:
        status = main(sys.argv[1:])
        sys.stdout.flush()
    except TaskError as error:  # of a tool; a run says more
        status = print_error(error, 1)
    except BrokenPipeError:  # the reader of the output closed the pipe
        status = 1
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    sys.stderr.flush()
    if status > 128 and "jax" in sys.modules:
        os._exit(status)
    sys.exit(status)
