"""What a configuration may be: the names that exist, and every field's range."""

import difflib
import math
from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from experiments.options import COPYING, Config, ConfigError

CONF = Path(__file__).parent / "conf"
GROUPS = ("env", "algo")  # of which every run names one each
CHOSEN = (*GROUPS, "preset")
BY_ID = {  # environments that are named by env.id=, each with one such task
    "envpool": "Pong-v5",
    "gymnasium": "CartPole-v1",
    "MiniGrid": "MiniGrid-DoorKey-8x8-v0",
}


def choices(group: str) -> dict[str, str]:
    """The names of a config group, each with the first line of its file that says something."""
    about = {}
    for path in sorted((CONF / group).glob("*.yaml")):
        comments = [
            line[2:].strip() for line in path.read_text().splitlines() if line.startswith("# ")
        ]
        about[path.stem] = next(line for line in comments if not line.startswith("@package"))
    return about


def options(node: Any = Config, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every option's dotted name with its dataclass field."""
    for entry in fields(node):
        if is_dataclass(entry.type):
            yield from options(entry.type, f"{prefix}{entry.name}.")
        elif entry.name != "name":  # of a group's choice; not for changing
            yield prefix + entry.name, entry


def unknown(what: str, name: str, known: Iterable[str]) -> ConfigError:
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


def value_of(config: Config, name: str) -> Any:
    """The value of an option by its dotted name.

    >>> value_of(Config(), "ppo.epochs")
    4
    """
    value: Any = config
    for part in name.split("."):
        value = getattr(value, part)
    return value


def validated(config: Any) -> Config:
    """The same configuration, once every field and every size was found possible."""
    for name, entry in options():
        value = value_of(config, name)
        if isinstance(value, dict):
            for key, one in value.items():
                check(f"{name}.{key}", one, entry.metadata)
        else:
            check(name, value, entry.metadata)
    if config.algo.module is None and config.algo.name not in choices("algo"):
        raise unknown("algo", config.algo.name, choices("algo"))
    for name in ("ppo", "algo") if config.algo.name != "ppo" else ("ppo",):
        size = getattr(config, name).minibatch_size
        if config.rows % size:
            raise ConfigError(
                f"{name}.minibatch_size={size} does not divide the rollout, num_envs="
                f"{config.num_envs} x rollout_length={config.rollout_length} = {config.rows} rows"
            )
    if config.algo.name == "ppo":
        if config.algo.eta != 0:
            raise ConfigError("algo.eta: algo=ppo has no intrinsic reward to scale")
        if config.ppo.ext_weight == 0:
            raise ConfigError("ppo.ext_weight=0 leaves algo=ppo nothing to learn from; take an SND")
    elif config.ppo.published_mask:
        raise ConfigError("ppo.published_mask repeats the published baseline: algo=ppo alone")
    elif config.ppo.ext_weight == config.ppo.int_weight == 0:
        raise ConfigError("ppo.ext_weight and ppo.int_weight are both 0: nothing to learn from")
    if config.algo.pairing != "asymmetric" and config.algo.signal not in COPYING:
        raise ConfigError(f"algo.pairing: algo={config.algo.name} has no network that copies")
    if config.algo.gradient != "symmetric" and config.algo.signal != "prediction":
        raise ConfigError(f"algo.gradient: algo={config.algo.name} has no forward loss")
    if config.seed + config.num_seeds > 2**31:
        raise ConfigError(f"seed={config.seed}: the last seed must be below 2**31")
    return config


def check(name: str, value: Any, limits: Any) -> None:
    """Raise unless the value is inside its range."""
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{name}={value}: must be finite")
    if limits["choices"] is not None and value not in limits["choices"]:
        raise unknown(f"value of {name}", str(value), limits["choices"])
    for bound, fails, words in (
        ("low", lambda v, b: v < b, "at least"),
        ("above", lambda v, b: v <= b, "more than"),
        ("high", lambda v, b: v > b, "at most"),
    ):
        if limits[bound] is not None and fails(value, limits[bound]):
            raise ConfigError(f"{name}={value}: must be {words} {limits[bound]}")
