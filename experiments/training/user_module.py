"""The user's intrinsic module: a function in a Python file that the command line names."""

from typing import Any

from sndjax import Architecture, IntrinsicModule

from ..config.user_function import call_user_function
from ..system.errors import ConfigError


def load_module(
    reference: str, num_actions: int, size: Architecture, **options: Any
) -> IntrinsicModule:
    """Call the user's function, and return the intrinsic module that it makes.

    Args:
      reference: FILE.py:FUNCTION, the user's function.
      num_actions: A, the number of actions of the environment.
      size: the sizes of the networks.
      **options: further arguments of the function, `module.NAME=`.

    Raises:
      ConfigError: the file or the function does not exist, the file or the function raises an
        error, or the function returns another type.
    """
    made = call_user_function("algo.module", reference, num_actions, size, **options)
    if not isinstance(made, IntrinsicModule):
        name = reference.rpartition(":")[2]
        raise ConfigError(
            f"algo.module={reference}: {name}(num_actions, size) must return an "
            f"sndjax.IntrinsicModule, not {type(made).__name__}"
        )
    return made
