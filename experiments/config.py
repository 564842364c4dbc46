"""From the command line to a validated `Config`, without importing jax."""

import difflib
import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from experiments.options import COPYING, OBJECTIVES, Config, ConfigError

CONF = Path(__file__).parent / "conf"
GROUPS = ("env", "algo")
BY_ID = ("envpool", "gymnasium")  # environments that are named by env.id=


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
    shown = ", ".join(known) if len(known) < 30 else "see --help"
    return ConfigError(f"unknown {what} '{name}'; there is {shown}")


def parse(arguments: list[str]) -> dict[str, Override]:
    """The overrides by key; refused where they are no key=value of a known key."""
    parser = OverridesParser.create()
    known = {name for name, _ in options()} | set(GROUPS)
    parsed: dict[str, Override] = {}
    for argument in arguments:
        try:
            override = parser.parse_override(argument)
        except HydraException:
            hint = "quote special characters" if "=" in argument else "write key=value"
            raise ConfigError(f"cannot read '{argument}': {hint}") from None
        key = override.key_or_group
        if override.is_delete() or override.package is not None:
            raise ConfigError(f"cannot read '{argument}': write key=value")
        if override.is_sweep_override():
            raise ConfigError(f"'{argument}' names several values; give one")
        if key not in known and not key.startswith("env.options."):
            raise unknown("option", key, known)
        if key in parsed:
            raise ConfigError(f"'{key}' is given twice")
        parsed[key] = override
    for group in GROUPS:
        if group in parsed and parsed[group].value() not in choices(group):
            name = str(parsed[group].value())
            hint = " (any envpool task: env=envpool env.id=NAME)" if group == "env" else ""
            raise ConfigError(f"{unknown(group, name, choices(group))}{hint}")
    return parsed


def schema() -> DictConfig:
    """The dataclasses as an OmegaConf schema that can still be merged into."""

    def thaw(node: DictConfig) -> DictConfig:
        OmegaConf.set_readonly(node, None)
        for key in node:
            child = node._get_node(key)
            if isinstance(child, DictConfig):
                thaw(child)
        return node

    return thaw(OmegaConf.structured(Config))


def load(arguments: list[str]) -> Config:
    """The configuration that the command line asks for.

    Raises:
      ConfigError: in one line, what is wrong with it and what would be right.
    """
    overrides = parse(arguments)
    if "resume" in overrides and overrides["resume"].value() is not None:
        return resumed(overrides)
    if "algo.module" in overrides:
        overrides.setdefault("algo", OverridesParser.create().parse_override("algo=module"))
    for group in GROUPS:
        if group not in overrides:
            names = ", ".join(choices(group))
            raise ConfigError(f"say {group}=NAME, one of: {names} (--help explains)")
    check_algorithm(overrides)
    lines = [line(override) for override in overrides.values()]
    env = str(overrides["env"].value())
    if env in BY_ID and "env.id" not in overrides:
        example = {"envpool": "Pong-v5", "gymnasium": "CartPole-v1"}[env]
        raise ConfigError(f"env={env} needs a task: env.id={example}, say")
    for key in ("env.id", "env.suite"):
        if key in overrides and env not in BY_ID:
            raise ConfigError(f"{key}: env={env} has its own; take env=envpool or env=gymnasium")
    if "env.id" in overrides and env != "gymnasium":
        from experiments.catalogue import family_of  # imports envpool

        family = family_of(str(overrides["env.id"].value()))
        if env == "envpool":
            lines.append(f"family@env={family}")
    if "algo.module" in overrides:
        lines.append(f"algo.name={function_of(str(overrides['algo.module'].value()))}")
    ConfigStore.instance().store(name="schema", node=schema())
    try:
        with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
            config = OmegaConf.to_object(compose("config", overrides=lines))
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(reason(error)) from None
    assert isinstance(config, Config)
    return validated(config)


def check_algorithm(overrides: dict[str, Override]) -> None:
    """Raise where the options that make up a cell do not go with the algorithm that is named."""
    algo = str(overrides["algo"].value())
    given = [k for k in ("algo.objective", "algo.signal") if k in overrides]
    if given and algo == "ppo":
        known = ", ".join(OBJECTIVES)
        raise ConfigError(
            f"algo=ppo has no encoder, so {given[0]} means nothing; take algo=grid "
            f"algo.objective=NAME algo.signal=NAME, objectives being {known}"
        )
    unused = {"ppo.int_weight", "ppo.gamma_int", "ppo.episodic_int"}
    unused |= {k for k in overrides if k.startswith("algo.")} - {"algo.eta"}
    if algo == "ppo" and unused & set(overrides):
        raise ConfigError(f"{min(unused & set(overrides))}: algo=ppo has no intrinsic reward")
    if given and algo != "grid":
        raise ConfigError(f"{given[0]}: algo={algo} is a cell with its own; take algo=grid")
    if algo == "grid" and len(given) < 2:
        raise ConfigError("algo=grid needs both algo.objective=NAME and algo.signal=NAME")
    if (algo == "module") != ("algo.module" in overrides):
        raise ConfigError("algo.module=FILE.py:FUNCTION goes with algo=module, and it with that")
    if algo == "module":
        for key in ("preprocess", "activation", "pairing", "gradient"):
            if f"algo.{key}" in overrides:
                raise ConfigError(f"algo.{key}: set it inside the function that algo.module names")


def function_of(module: str) -> str:
    """The function's name in FILE.py:FUNCTION."""
    path, colon, name = module.rpartition(":")
    if not (colon and path.endswith(".py") and name.isidentifier()):
        raise ConfigError(f"algo.module={module}: write FILE.py:FUNCTION")
    if not Path(path).is_file():
        raise ConfigError(f"algo.module={module}: there is no file {path}")
    if name in choices("algo"):
        raise ConfigError(f"algo.module={module}: {name} is an algorithm; call yours otherwise")
    return name


def line(override: Override) -> str:
    """The override as Hydra reads it; envpool's own options may be new keys."""
    assert override.input_line is not None
    text = override.input_line.lstrip("+")
    return f"++{text}" if override.key_or_group.startswith("env.options.") else text


def reason(error: Exception) -> str:
    """The innermost cause of a Hydra or OmegaConf error, on one line."""
    while error.__cause__ is not None and isinstance(error.__cause__, Exception):
        error = error.__cause__
    lines = [part.strip() for part in str(error).splitlines() if part.strip()]
    keys = [part.split(":", 1)[1].strip() for part in lines if part.startswith("full_key:")]
    return f"{keys[0]}: {lines[0]}" if keys else lines[0]


def resumed(overrides: dict[str, Override]) -> Config:
    """The configuration of the run to go on with; other options may only repeat it."""
    directory = Path(str(overrides.pop("resume").value()))
    path = directory / "config.yaml"
    if not path.is_file():
        raise ConfigError(f"resume={directory}: there is no run (no config.yaml)")
    try:
        stored = OmegaConf.to_object(OmegaConf.merge(schema(), OmegaConf.load(path)))
    except (OmegaConfBaseException, yaml.YAMLError, OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} cannot be read: {reason(error)}") from None
    assert isinstance(stored, Config)
    values = OmegaConf.create(asdict(stored))
    if stored.algo.module is not None and "algo.module" not in overrides:
        raise ConfigError(
            "resume: the run is of a bonus that is code, and no stored file may name code; "
            f"say algo.module={stored.algo.module} again if you trust it"
        )
    if stored.env.suite == "gymnasium" and ":" in stored.env.id and "env.id" not in overrides:
        raise ConfigError(
            "resume: the run's task names a Python module, and no stored file may name code; "
            f"say env.id={stored.env.id} again if you trust it"
        )
    for key, override in overrides.items():
        if key == "run_dir":
            raise ConfigError("resume already names the run directory; leave run_dir out")
        was = OmegaConf.select(values, f"{key}.name" if key in GROUPS else key)
        if key == "env" and override.value() in BY_ID:
            continue
        if key == "algo" and override.value() == "module" and stored.algo.module is not None:
            continue
        if was != override.value():
            raise ConfigError(f"resume: the run has {key}={was}, not {override.value()}")
    return validated(
        OmegaConf.to_object(
            OmegaConf.merge(schema(), values, {"resume": str(directory), "run_dir": str(directory)})
        )
    )


def validated(config: Any) -> Config:
    """The same configuration, once every field and every size was found possible."""
    for name, entry in options():
        value: Any = config
        for part in name.split("."):
            value = getattr(value, part)
        check(name, value, entry.metadata)
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


def to_yaml(config: Config) -> str:
    """Every option of a run, defaults too, as it can be resumed from."""
    return yaml.safe_dump(asdict(config) | {"resume": None}, sort_keys=False)


def help_text() -> str:
    """What `--help` prints."""
    lines = [
        "usage: python -m experiments.run env=NAME algo=NAME [key=value ...]",
        "",
        "Trains PPO with an intrinsic reward, for example:",
        "  python -m experiments.run env=MountainCar algo=snd_vic",
        "  python -m experiments.run env=Venture algo=snd_std num_seeds=3 total_steps=1_000_000",
        "  python -m experiments.run resume=runs/Venture/snd_std/<time>-<id>",
    ]
    for group, title in (("env", "environments"), ("algo", "algorithms")):
        names = choices(group)
        lines += ["", f"{title} ({group}=NAME)"]
        lines += [f"  {name:<18} {about}" for name, about in names.items()]
    lines += ["", "options (key=value, with their defaults; env and algo may change them)"]
    for name, entry in options():
        default = (
            entry.default if entry.default_factory.__class__.__name__ == "_MISSING_TYPE" else {}
        )
        shown = {"???": "", None: ""}.get(
            default if not isinstance(default, dict) else None, default
        )
        values = entry.metadata["choices"]
        about = entry.metadata["about"] + (f" [{' | '.join(values)}]" if values else "")
        lines.append(f"  {name + '=' + str(shown):<34} {about}")
    return "\n".join(lines)
