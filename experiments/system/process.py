"""What the process is told before jax starts in it and after, and how a script ends."""

import ctypes
import os
import sys
import warnings
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

# Orders an update's operations for memory on a CPU: a third less of it
# (1.84 GB of temporaries become 1.21 GB for snd_std on Atari). XLA aborts on a flag that
# it does not know, so it is set only for the versions that it was tried with.
MEMORY_SCHEDULE = "--xla_cpu_enable_concurrency_optimized_scheduler=false"
TRIED_VERSIONS = ("0.10.",)


def configure_xla() -> None:
    """Set XLA's flags, which are read once, when jax first computes, and silence its warnings."""
    warnings.filterwarnings("ignore", message=".*Box (low|high)'s precision.*")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "1")
    flags = os.environ.get("XLA_FLAGS", "")
    if version("jaxlib").startswith(TRIED_VERSIONS) and MEMORY_SCHEDULE not in flags:
        os.environ["XLA_FLAGS"] = f"{MEMORY_SCHEDULE} {flags}".strip()


def return_freed_memory() -> None:
    """Return to the system the memory that start-up and compilation have freed (glibc keeps it)."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def enable_compilation_cache() -> None:
    """Turn on jax's compilation cache, so that the next run of the same sizes starts at once."""
    import jax  # not before `configure_xla`

    default = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "sndjax" / "jax"
    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_compilation_cache_dir", str(default))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def rss_mb() -> float:
    """Return the resident memory of this process in MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def run_script(main: Callable[[list[str]], int]) -> None:
    """Run a command with the arguments of this process, and exit with its status.

    A reader of its output that goes away ends it without a traceback. A status of a signal
    (128 + its number) leaves at once: an update that was broken off may have minutes to go.
    """
    try:
        status = main(sys.argv[1:])
        sys.stdout.flush()
    except BrokenPipeError:  # nobody reads any more
        status = 1
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    sys.stderr.flush()
    if status > 128 and "jax" in sys.modules:
        os._exit(status)
    sys.exit(status)
