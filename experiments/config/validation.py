"""What a configuration may be: the names that exist, and every field's range."""

import difflib
import math
from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from ..system.errors import ConfigError
from .library import algorithm_table, has_forward_model, has_predictor
from .schema import Config

CONF = Path(__file__).parents[1] / "conf"
GROUPS = ("env", "algo")  # of which every run names one each
ALL_GROUPS = (*GROUPS, "preset")
GENERIC_ENVS = {  # environments that are named by env.id=, each with one such task
    "envpool": "Pong-v5",
    "gymnasium": "CartPole-v1",
    "MiniGrid": "MiniGrid-DoorKey-8x8-v0",
}


def group_choices(group: str) -> dict[str, str]:
    """Return the names of a config group with what each is: from its file, or from the table."""
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
    """Every option's dotted name with its dataclass field."""
    for entry in fields(node):
        if is_dataclass(entry.type):
            yield from config_options(entry.type, f"{prefix}{entry.name}.")
        elif entry.name != "name":  # of a group's choice; not for changing
            yield prefix + entry.name, entry


def unknown_name_error(what: str, name: str, known: Iterable[str]) -> ConfigError:
    """The refusal of a name, with the ones it may have meant."""
    known = sorted(known)
    lower = {k.lower(): k for k in known}
    near = difflib.get_close_matches(name.lower(), lower, n=3, cutoff=0.5)
    near += [k for k in lower if k.rsplit(".", 1)[-1] == name.lower() and k not in near]
    if near:
        return ConfigError(
            f"unknown {what} '{name}'; did you mean {' or '.join(lower[k] for k in near)}?"
        )
    shown = f"there is {', '.join(known)}" if len(known) < 30 else "see --help"
    return ConfigError(f"unknown {what} '{name}'; {shown}")


def get_option(config: Config, name: str) -> Any:
    """The value of an option by its dotted name.

    >>> get_option(Config(), "ppo.epochs")
    4
    """
    value: Any = config
    for part in name.split("."):
        value = getattr(value, part)
    return value


def validate_config(config: Any) -> Config:
    """Return the configuration once every field, every size and their combination is possible.

    Raises:
      ConfigError: the first that is not.
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
    """Raise unless the algorithm exists and has the objective and the signal of its name."""
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
    """Raise unless the minibatch sizes divide the rollout."""
    for name in ("ppo", "algo") if config.algo.name != "ppo" else ("ppo",):
        size = getattr(config, name).minibatch_size
        if config.rows % size:
            raise ConfigError(
                f"{name}.minibatch_size={size} does not divide the rollout, num_envs="
                f"{config.num_envs} x rollout_length={config.rollout_length} = {config.rows} rows"
            )


def check_rewards(config: Config) -> None:
    """Raise unless there is a reward to learn from, and no scale of one that is not there."""
    if config.algo.name == "ppo":
        if config.algo.eta != 0:
            raise ConfigError("algo.eta: algo=ppo has no intrinsic reward to scale")
        if config.ppo.ext_weight == 0:
            raise ConfigError(
                "ppo.ext_weight=0: with algo=ppo there is no other reward; "
                "choose an intrinsic algorithm"
            )
    elif config.ppo.published_mask:
        raise ConfigError("ppo.published_mask repeats the published baseline: algo=ppo alone")
    elif config.ppo.ext_weight == config.ppo.int_weight == 0:
        raise ConfigError("ppo.ext_weight and ppo.int_weight are both 0: nothing to learn from")


def check_range(name: str, value: Any, limits: Any) -> None:
    """Raise unless the value is inside its range."""
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
