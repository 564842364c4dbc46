"""The names that a configuration may use, and the range of a value."""

import difflib
import math
from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

from ..system.errors import ConfigError
from .jax_suites import JAX_SUITES
from .library import algorithm_table
from .other_names import other_name_hint
from .schema import Config

CONF = Path(__file__).parents[1] / "conf"
GROUPS = ("env", "algo")  # every run names one choice of each
NAMED_GROUPS = (*GROUPS, "network")  # each has a `name` in the configuration
ALL_GROUPS = (*NAMED_GROUPS, "preset")
GENERIC_ENVS = {  # environments whose task is given by env.id=, with an example
    "envpool": "Pong-v5",
    "gymnasium": "CartPole-v1",
    "MiniGrid": "MiniGrid-DoorKey-8x8-v0",
    **{name: suite.example for name, suite in JAX_SUITES.items()},
}
# Environments whose task another suite has too.
OTHER_SUITES = {"MountainCar": ("envpool", "gymnasium", "gymnax")}


def group_choices(group: str) -> dict[str, str]:
    """Return the choices of a config group, each with a description.

    The description comes from the table of algorithms, or from a comment in the choice's file.
    """
    about = {}
    if group == "algo":
        about = {name: row.summary for name, row in algorithm_table().items()}
    for path in sorted((CONF / group).glob("*.yaml")):
        comments = [
            line[2:].strip() for line in path.read_text().splitlines() if line.startswith("# ")
        ]
        about.setdefault(path.stem, next(c for c in comments if not c.startswith("@package")))
    return dict(sorted(about.items()))


def config_options(node: Any = Config, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted name and the dataclass field of every option."""
    for entry in fields(node):
        if is_dataclass(entry.type):
            yield from config_options(entry.type, f"{prefix}{entry.name}.")
        elif entry.name != "name":  # set by the config group; not user-editable
            yield prefix + entry.name, entry


def unknown_name_error(what: str, name: str, known: Iterable[str]) -> ConfigError:
    """Return the error for an unknown name, with the known names that are similar.

    Args:
      what: the kind of thing that is named, such as "option".
      name: the unknown name.
      known: all known names.
    """
    known = sorted(known)
    elsewhere = other_name_hint(name, {*known}) if what == "option" else ""
    if elsewhere:
        return ConfigError(f"unknown {what} '{name}'; here it is {elsewhere}")
    lower = {k.lower(): k for k in known}
    near = difflib.get_close_matches(name.lower(), lower, n=3, cutoff=0.5)
    near += [k for k in lower if k.rsplit(".", 1)[-1] == name.lower() and k not in near]
    if near:
        return ConfigError(
            f"unknown {what} '{name}'; did you mean {' or '.join(lower[k] for k in near)}?"
        )
    shown = f"known: {', '.join(known) or 'none'}" if len(known) < 30 else "see --help"
    return ConfigError(f"unknown {what} '{name}'; {shown}")


def whole_number(text: str) -> int:
    """Return the whole number that a text writes; also 1e6, 1_000 and 2.0.

    Raises:
      ValueError: the text is no number, or the number is not whole.

    >>> whole_number("1e6"), whole_number("1_000"), whole_number("2.0")
    (1000000, 1000, 2)
    """
    try:
        return int(text)
    except ValueError:
        if not float(text).is_integer():  # also nan and inf
            raise
        return int(Decimal(text))


def get_option(config: Config, name: str) -> Any:
    """Return the value of an option by its dotted name.

    >>> get_option(Config(), "ppo.epochs")
    4
    """
    value: Any = config
    for part in name.split("."):
        value = getattr(value, part)
    return value


def check_range(name: str, value: Any, limits: Any) -> None:
    """Check that the value of an option is inside its range.

    Args:
      name: the name of the option, for error messages.
      value: the value of the option.
      limits: the metadata of the option's field: low, high, above and choices.

    Raises:
      ConfigError: the value is not finite, or not allowed.
    """
    if value is None:  # an option that may be left out
        return
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{name}={value}: must be finite")
    if limits["choices"] is not None and str(value) not in limits["choices"]:
        raise unknown_name_error(f"value of {name}", str(value), limits["choices"])
    for bound, fails, words in (
        ("low", lambda v, b: v < b, "at least"),
        ("above", lambda v, b: v <= b, "more than"),
        ("high", lambda v, b: v > b, "at most"),
    ):
        if limits[bound] is not None and fails(value, limits[bound]):
            raise ConfigError(f"{name}={value}: must be {words} {limits[bound]}")
