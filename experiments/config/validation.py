"""Validation of a configuration: the names that exist, and the range of every field."""

import difflib
import math
from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

from ..system.errors import ConfigError
from .jax_suites import JAX_SUITES
from .library import algorithm_table, has_forward_model, has_predictor
from .other_names import other_name_hint
from .schema import Config

CONF = Path(__file__).parents[1] / "conf"
GROUPS = ("env", "algo")  # every run names one choice of each
ALL_GROUPS = (*GROUPS, "preset")
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


def validate_config(config: Any) -> Config:
    """Check every field, every size and their combination, and return the configuration.

    Raises:
      ConfigError: a value or a combination is not allowed; the message names the first.
    """
    for name, entry in config_options():
        value = get_option(config, name)
        if isinstance(value, dict):
            for key, one in value.items():
                check_range(f"{name}.{key}", one, entry.metadata)
        else:
            check_range(name, value, entry.metadata)
    check_algorithm_name(config)
    check_minibatches(config)
    check_rewards(config)
    if config.algo.pairing != "asymmetric" and not has_predictor(config.algo.signal):
        raise ConfigError(f"algo.pairing: algo={config.algo.name} has no predictor network")
    if config.algo.gradient != "symmetric" and not has_forward_model(config.algo.signal):
        raise ConfigError(f"algo.gradient: algo={config.algo.name} has no forward loss")
    if config.seed + config.num_seeds > 2**31:
        raise ConfigError(f"seed={config.seed}: the last seed must be below 2**31")
    return config


def check_algorithm_name(config: Config) -> None:
    """Check that the algorithm exists and has the objective and the signal of its name.

    Raises:
      ConfigError: the algorithm is unknown, or its objective or its signal is another one.
    """
    algo = config.algo
    if algo.module is None and algo.name not in group_choices("algo"):
        raise unknown_name_error("algo", algo.name, group_choices("algo"))
    row = algorithm_table().get(algo.name) if algo.module is None else None
    if row is None or row.objective is None:
        return
    for what in ("objective", "signal"):
        given, own = getattr(algo, what), getattr(row, what)
        if given != own:
            raise ConfigError(
                f"algo.{what}={given}: algo={algo.name} is {own}; "
                "write algo=grid for another combination"
            )


def check_minibatches(config: Config) -> None:
    """Check that the minibatch sizes divide the rollout.

    Raises:
      ConfigError: a minibatch size does not divide the rollout.
    """
    for name in ("ppo", "algo") if config.algo.name != "ppo" else ("ppo",):
        size = getattr(config, name).minibatch_size
        if config.rows % size:
            raise ConfigError(
                f"{name}.minibatch_size={size} does not divide the rollout, num_envs="
                f"{config.num_envs} x rollout_length={config.rollout_length} = {config.rows} rows"
            )


def check_rewards(config: Config) -> None:
    """Check that there is a reward to learn from, and no option for a missing reward.

    Raises:
      ConfigError: all rewards have weight 0, or an option does not fit the algorithm.
    """
    if config.algo.name == "ppo":
        if config.algo.eta != 0:
            raise ConfigError("algo.eta: algo=ppo has no intrinsic reward to scale")
        if config.ppo.ext_weight == 0:
            raise ConfigError(
                "ppo.ext_weight=0: with algo=ppo there is no other reward; "
                "choose an intrinsic algorithm"
            )
    elif config.ppo.published_mask:
        raise ConfigError(
            "ppo.published_mask repeats the published baseline: use it only with algo=ppo"
        )
    elif config.ppo.ext_weight == config.ppo.int_weight == 0:
        raise ConfigError("ppo.ext_weight and ppo.int_weight are both 0: nothing to learn from")


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
    if limits["choices"] is not None and value not in limits["choices"]:
        raise unknown_name_error(f"value of {name}", str(value), limits["choices"])
    for bound, fails, words in (
        ("low", lambda v, b: v < b, "at least"),
        ("above", lambda v, b: v <= b, "more than"),
        ("high", lambda v, b: v > b, "at most"),
    ):
        if limits[bound] is not None and fails(value, limits[bound]):
            raise ConfigError(f"{name}={value}: must be {words} {limits[bound]}")
