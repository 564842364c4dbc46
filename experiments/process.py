"""What the process is told before jax starts in it, and after."""

import ctypes
import os
import warnings
from importlib.metadata import version
from pathlib import Path

# Orders an update's operations for memory on a CPU: a third less of it
# (1.84 GB of temporaries become 1.21 GB for snd_std on Atari). XLA aborts on a flag that
# it does not know, so it is set for the versions alone that it was tried with.
MEMORY_SCHEDULE = "--xla_cpu_enable_concurrency_optimized_scheduler=false"
TRIED = ("0.10.",)


def before_jax() -> None:
    """Set XLA's flags, which are read once, when jax first computes, and silence others."""
    warnings.filterwarnings("ignore", message=".*Box (low|high)'s precision.*")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "1")
    if version("jaxlib").startswith(TRIED):
        os.environ["XLA_FLAGS"] = f"{MEMORY_SCHEDULE} {os.environ.get('XLA_FLAGS', '')}".strip()


def return_freed_memory() -> None:
    """Give the system back what start-up and compilation have freed (glibc keeps it)."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def keep_compilations() -> None:
    """Turn on jax's compilation cache, so that the next run of the same sizes starts at once."""
    import jax  # not before `before_jax`

    default = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "sndjax" / "jax"
    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_compilation_cache_dir", str(default))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def rss_mb() -> float:
    """Resident memory of this process, in MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
