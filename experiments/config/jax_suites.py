"""The libraries of environments that live in JAX: their packages, and an example of each."""

import importlib.util
from typing import NamedTuple

from ..system.errors import ConfigError


class JaxSuite(NamedTuple):
    """A library of environments that live in JAX.

    Attributes:
      package: what must be importable; None for the user's own file.
      example: a task.
      remark: what else its installation needs.
    """

    package: str | None
    example: str
    remark: str = ""


JAX_SUITES = {
    "gymnax": JaxSuite("gymnax", "DeepSea-bsuite"),
    "navix": JaxSuite("navix", "Navix-DoorKey-8x8-v0", "; navix 4 needs Python 3.12 or newer"),
    "craftax": JaxSuite("craftax", "Craftax-Classic-Symbolic-v1"),
    "xminigrid": JaxSuite("xminigrid", "MiniGrid-DoorKey-8x8"),
    "levels": JaxSuite("minigrid", "MiniGrid-DoorKey-16x16-v0"),
    "jax": JaxSuite(None, "my_file.py:make"),
}


def check_installed(suite: str) -> None:
    """Check that the package of a suite is installed; nothing is imported.

    Raises:
      ConfigError: it is not; the message says what to install.
    """
    found = JAX_SUITES.get(suite)
    if found is None or found.package is None or importlib.util.find_spec(found.package):
        return
    raise ConfigError(
        f"env.suite={suite} needs the package {found.package}: "
        f"pip install 'sndjax[jax-envs]'{found.remark}"
    )
