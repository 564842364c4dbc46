"""The versions of the software and the device that a run uses."""

import platform
import subprocess
from importlib.metadata import version
from pathlib import Path

PACKAGES = ("jax", "jaxlib", "flax", "optax", "envpool", "numpy")


def package_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that compute."""
    found = {"python": platform.python_version()}
    return found | {name: version(name) for name in PACKAGES}


def version_line() -> str:
    """Return the line that `--version` prints."""
    others = ", ".join(f"{name} {number}" for name, number in package_versions().items())
    return f"sndjax {version('sndjax')} ({others})"


def versions() -> dict[str, str]:
    """Return the versions of Python and the packages, the device, and the git revision."""
    import jax  # imported here: `jax.devices` is the first request for a device

    found = package_versions()
    found["device"] = jax.devices()[0].device_kind
    git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        result = subprocess.run(git, capture_output=True, text=True, timeout=5, check=False)
        found["revision"] = result.stdout.strip() or "unknown"
    except (OSError, subprocess.SubprocessError):
        found["revision"] = "unknown"
    return found
