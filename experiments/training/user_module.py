"""A bonus of the user's own: the function in a Python file that the command line names."""

import importlib.util
import os
import sys
from pathlib import Path
from typing import Any

from sndjax import Architecture, IntrinsicModule

from ..config.compose import function_name
from ..system.errors import ConfigError


def load_module(reference: str, num_actions: int, size: Architecture) -> IntrinsicModule:
    """The module that FILE.py:FUNCTION makes of the number of actions and the network sizes.

    This runs the file. Its name may come from the command line alone.

    Raises:
      ConfigError: there is no such file or function, it fails, or it makes something else.
    """
    name, path = function_name(reference), reference.rpartition(":")[0]
    spec = importlib.util.spec_from_file_location("sndjax_user_module", path)
    assert spec is not None
    assert spec.loader is not None
    # What the file imports from beside it, or from where the command was given, is found last.
    folders = (str(Path(path).resolve().parent), os.getcwd())
    sys.path += [folder for folder in folders if folder not in sys.path]
    loaded: Any = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = loaded  # dataclasses look their module up there
    try:
        spec.loader.exec_module(loaded)
        if not callable(getattr(loaded, name, None)):
            raise ConfigError(f"algo.module={reference}: {path} has no function {name}")
        made = getattr(loaded, name)(num_actions, size)
    except ConfigError:
        raise
    except (Exception, SystemExit) as error:  # the user's code may raise anything
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
    """Where in the user's file an error came from."""
    lines, trace = [], error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == path:
            lines.append(trace.tb_lineno)
        trace = trace.tb_next
    return f" in line {lines[-1]}" if lines else ""
