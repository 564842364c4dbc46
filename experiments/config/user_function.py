"""A function in a Python file of the user's that the command line names, FILE.py:FUNCTION."""

import importlib.util
import os
import sys
from pathlib import Path
from typing import Any

from ..system.errors import ConfigError


def split_reference(option: str, reference: str) -> tuple[str, str]:
    """Return the file and the name of the function in FILE.py:FUNCTION.

    Args:
      option: the option that holds the reference, for error messages.
      reference: the text.

    Raises:
      ConfigError: the text has another form, or the file does not exist.
    """
    path, colon, name = reference.rpartition(":")
    if not (colon and path.endswith(".py") and name.isidentifier()):
        raise ConfigError(f"{option}={reference}: write FILE.py:FUNCTION")
    if not Path(path).is_file():
        raise ConfigError(f"{option}={reference}: there is no file {path}")
    return path, name


def call_user_function(option: str, reference: str, *args: Any, **options: Any) -> Any:
    """Call the user's function, and return what it returns.

    This runs the file. For safety, its name may come only from the command line.

    Args:
      option: the option that holds the reference, for error messages.
      reference: FILE.py:FUNCTION.
      *args: arguments of the function.
      **options: further ones.

    Raises:
      ConfigError: the file or the function does not exist or raises an error.
    """
    path, name = split_reference(option, reference)
    module = f"sndjax_user_{option.replace('.', '_')}"
    spec = importlib.util.spec_from_file_location(module, path)
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
            raise ConfigError(f"{option}={reference}: {path} has no function {name}")
        return getattr(loaded, name)(*args, **options)
    except ConfigError:
        raise
    except (Exception, SystemExit) as error:  # the user's code may raise any exception
        kind = type(error).__name__
        where = error_line(error, path)
        raise ConfigError(f"{option}={reference}: {kind}{where}: {error}") from None


def error_line(error: BaseException, path: str) -> str:
    """Return the line of the user's file that raised an error, as " in line N"; "" if unknown."""
    lines, trace = [], error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == path:
            lines.append(trace.tb_lineno)
        trace = trace.tb_next
    return f" in line {lines[-1]}" if lines else ""
