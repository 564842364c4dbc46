"""The options of a run on a command line, as Hydra's overrides with values of the right kind."""

import json
from functools import cache
from types import NoneType
from typing import Any, get_args, get_origin

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException

from ..system.errors import ConfigError
from .cell_options import library_options
from .command_text import option_text, shell_text
from .validation import (
    ALL_GROUPS,
    config_options,
    group_choices,
    unknown_name_error,
    whole_number,
)

# The options below these are those of a library that makes the task, and of constructors.
FREE_OPTIONS = ("env.options.", "objective.", "signal.", "module.")
INSTEAD = {  # what to write where a mapping is wanted
    "env.options": "write env.options.NAME=VALUE for each entry",
    "env.eta": "write algo.eta=VALUE",
    "objective": "write objective.NAME=VALUE for each entry",
    "signal": "write signal.NAME=VALUE for each entry",
    "module": "write module.NAME=VALUE for each entry",
}


@cache
def option_kinds() -> dict[str, type]:
    """Return the type of every option by its name: bool, int, float, str, list or dict."""
    found: dict[str, Any] = {}
    for name, entry in config_options():
        found[name] = get_origin(entry.type) or entry.type
        if name in nullable_options():
            (kind,) = set(get_args(entry.type)) - {NoneType}
            found[name] = get_origin(kind) or kind
    return found


@cache
def nullable_options() -> set[str]:
    """Return the names of the options whose value may be null."""
    return {name for name, entry in config_options() if NoneType in get_args(entry.type)}


def parse_overrides(arguments: list[str]) -> dict[str, Override]:
    """Parse the arguments of the command line into overrides by key.

    Raises:
      ConfigError: an argument is not key=value, its key or group choice is unknown, it has several
        values or a value of another kind, or a key is given twice.
    """
    known = {*option_kinds(), *ALL_GROUPS}
    parsed: dict[str, Override] = {}
    for argument in arguments:
        override = parse_argument(argument)
        key = override.key_or_group
        if override.is_delete() or override.package is not None:
            raise ConfigError(f"cannot read '{argument}': write key=value")
        if override.is_sweep_override():
            hint = text_hint(argument) or f"for a sweep: -m {shell_text(argument)}"
            raise ConfigError(f"'{argument}' names several values; give one ({hint})")
        if key not in known and not key.startswith(FREE_OPTIONS):
            raise unknown_name_error("option", key, known | {*library_options()})
        if key in parsed:
            raise ConfigError(f"'{key}' is given twice")
        parsed[key] = typed_override(override)
    for group in ALL_GROUPS:
        if group in parsed and parsed[group].value() not in group_choices(group):
            name = str(parsed[group].value())
            hint = " (any envpool task: env=envpool env.id=NAME)" if group == "env" else ""
            raise ConfigError(f"{unknown_name_error(group, name, group_choices(group))}{hint}")
    return parsed


def parse_argument(argument: str) -> Override:
    """Parse one argument.

    Raises:
      ConfigError: Hydra cannot read it.
    """
    try:
        return OverridesParser.create().parse_override(argument)
    except (HydraException, ValueError, RecursionError):
        hint = "quote special characters" if "=" in argument else "write key=value"
        raise ConfigError(f"cannot read '{argument}': {text_hint(argument) or hint}") from None


def text_hint(argument: str) -> str:
    """Return how to write an argument whose value is any text, or "" for other options."""
    key, equals, text = argument.partition("=")
    free = equals and option_kinds().get(key) is str
    entry = dict(config_options()).get(key)
    if not free or entry is None or entry.metadata["choices"]:
        return ""
    return f"in a shell write {shell_text(option_text(key, text))}"


def typed_override(override: Override) -> Override:
    """Return an override whose value is of its option's kind.

    A whole number may be written as 1e6 or 2.0 (for the library that makes the task only as 1e6,
    because it may want 2.0). An option that takes text takes it as it is written, also if it looks
    like a number.

    Raises:
      ConfigError: the value is a list, a mapping or a number that is not whole, and may not be.
    """
    key, value = override.key_or_group, override.value()
    kind: Any = str if key in ALL_GROUPS else option_kinds().get(key)
    assert override.input_line is not None
    written = override.input_line.partition("=")[2]
    if kind is None:  # an argument of the library that makes the task
        whole = isinstance(value, float) and value.is_integer() and "e" in written.lower()
        return parse_argument(f"{key}={whole_number(str(value))}") if whole else override
    if kind is dict:
        if not isinstance(value, dict):
            raise ConfigError(f"{key}={written}: {INSTEAD[key]}")
        return override
    if kind is list and isinstance(value, list):
        return whole_list(key, written, value)
    if kind is list and value is not None:
        raise ConfigError(f"{key}={written}: write a list, such as {key}=[{written}]")
    if isinstance(value, list | dict) or (value is None and key not in nullable_options()):
        raise single_value_error(key, written, value)
    if kind is str and isinstance(value, bool | int | float):
        return parse_argument(option_text(key, written.strip()))
    if kind in (int, float) and isinstance(value, bool):
        raise ConfigError(f"{key}={written}: must be a number, not true or false")
    if kind is bool and isinstance(value, int | float) and not isinstance(value, bool):
        raise ConfigError(f"{key}={written}: must be true or false")
    if kind is int and isinstance(value, float | str) and "${" not in written:
        try:
            return parse_argument(f"{key}={whole_number(str(value))}")
        except ValueError:
            raise ConfigError(f"{key}={written}: must be a whole number") from None
    return override


def whole_list(key: str, written: str, value: list[Any]) -> Override:
    """Return the override of an option that takes a list of whole numbers.

    Args:
      key: the name of the option.
      written: the value as it was written.
      value: the value that Hydra read.

    Raises:
      ConfigError: an entry is no whole number.
    """
    try:
        if any(isinstance(entry, bool) for entry in value):
            raise ValueError
        entries = [whole_number(str(entry)) for entry in value]
    except ValueError:
        raise ConfigError(
            f"{key}={written}: must be a list of whole numbers, such as {key}=[64,64]"
        ) from None
    return parse_argument(f"{key}=[{','.join(map(str, entries))}]")


def single_value_error(key: str, written: str, value: Any) -> ConfigError:
    """Return the error for a list, a mapping or null, where an option takes one value.

    Args:
      key: the name of the option.
      written: the value as it was written.
      value: the value that Hydra read.
    """
    what = "a list" if isinstance(value, list) else "no value" if value is None else "a mapping"
    example = f"{key}=VALUE"
    if isinstance(value, list) and value and not any(isinstance(x, list | dict) for x in value):
        write = lambda x: option_text("", x)[1:] if isinstance(x, str) else json.dumps(x)
        example = f"{key}={write(value[0])}"
        if len(value) > 1 and not text_hint(f"{key}={written}"):
            several = f"{key}={','.join(map(write, value))}"
            example += f", or for a sweep -m {shell_text(several)}"
    elif key in ALL_GROUPS:
        example = f"{key}=NAME; known: {', '.join(group_choices(key))}"
    return ConfigError(f"{key}={written}: this is {what}; give one value: {example}")


def normalize_overrides(arguments: list[str]) -> list[str]:
    """Return the arguments with each whole number written as one: 1e6 becomes 1000000.

    Arguments that are not valid are returned as they are.

    >>> normalize_overrides(["seed=1e1", "algo.eta=1e1", "total_steps=2.5"])
    ['seed=10', 'algo.eta=1e1', 'total_steps=2.5']
    """
    found = []
    for argument in arguments:
        try:
            line = typed_override(parse_argument(argument)).input_line
        except ConfigError:
            line = argument
        found.append(line if option_kinds().get(argument.partition("=")[0]) is int else argument)
    return [str(line) for line in found]
