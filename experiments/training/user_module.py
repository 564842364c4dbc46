"""The user's intrinsic module: a function in a Python file that the command line names."""

import importlib.util
import os
import sys
from pathlib import Path
from typing import Any

from sndjax import Architecture, IntrinsicModule

from ..config.compose import function_name
from ..system.errors import ConfigError


def load_module(reference: str, num_actions: int, size: Architecture) -> IntrinsicModule:
    """Call the user's function, and return the intrinsic module that it makes.

    This runs the file. For safety, its name may come only from the command line.

    Args:
      reference: FILE.py:FUNCTION, the user's function.
      num_actions: A, the number of actions of the environment.
      size: the sizes of the networks.

    Raises:
      ConfigError: the file or the function does not exist, the file or the function raises an
        error, or the function returns another type.
    """
    name, path = function_name(reference), reference.rpartition(":")[0]
    spec = importlib.util.spec_from_file_location("sndjax_user_module", path)
    assert spec is not None
    assert spec.loader is not None
    # The file may import from its folder and from the current one; these are searched last.
    folders = (str(Path(path).resolve().parent), os.getcwd())
    sys.path += [folder for folder in folders if folder not in sys.path]
    loaded: Any = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = loaded  # dataclasses look up their module there
    try:
        spec.loader.exec_module(loaded)
        if not callable(getattr(loaded, name, None)):
            raise ConfigError(f"algo.module={reference}: {path} has no function {name}")
        made = getattr(loaded, name)(num_actions, size)
    except ConfigError:
        raise
    except (Exception, SystemExit) as error:  # the user's code may raise any exception
        kind = type(error).__name__
        where = error_line(error, path)
        raise ConfigError(f"algo.module={reference}: {kind}{where}: {error}") from None
    if not isinstance(made, IntrinsicModule):
        raise ConfigError(
            f"algo.module={reference}: {name}(num_actions, size) must return an "
            f"sndjax.IntrinsicModule, not {type(made).__name__}"
        )
    return made


def error_line(error: BaseException, path: str) -> str:
    """Return the line of the user's file that raised an error, as " in line N"; "" if unknown."""
    lines, trace = [], error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == path:
            lines.append(trace.tb_lineno)
        trace = trace.tb_next
    return f" in line {lines[-1]}" if lines else ""
