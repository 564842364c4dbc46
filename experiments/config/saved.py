"""Stored configurations, read to resume or to repeat a run.

They may come from an untrusted source: nothing in them is evaluated, and they may not name code.
"""

from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ..system.errors import ConfigError
from ..system.files import is_file
from .command_text import code_options, shell_text
from .config_checks import validate_config
from .earlier_options import rename_earlier
from .run_settings import CHANGEABLE, run_settings
from .schema import Config
from .validation import (
    GENERIC_ENVS,
    NAMED_GROUPS,
    config_options,
    whole_number,
)

CONFIG = "config.yaml"
MADE_WITH = "made_with"


class SavedConfig(NamedTuple):
    """A configuration with the versions that the run was made with."""

    config: Config
    made_with: dict[str, str]


class NoAliasLoader(yaml.SafeLoader):
    """A YAML loader that refuses aliases, because a few nested aliases could fill the memory."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("it has an alias")
        return super().compose_node(parent, index)


def config_schema() -> DictConfig:
    """Return the dataclasses as an OmegaConf schema that other values can be merged into."""

    def thaw(node: DictConfig) -> DictConfig:
        OmegaConf.set_readonly(node, None)
        for key in node:
            child = node._get_node(key)
            if isinstance(child, DictConfig):
                thaw(child)
        return node

    return thaw(OmegaConf.structured(Config))


def innermost_reason(error: Exception) -> str:
    """Return the innermost cause of a Hydra or OmegaConf error, on one line."""
    while error.__cause__ is not None and isinstance(error.__cause__, Exception):
        error = error.__cause__
    lines = [part.strip() for part in str(error).splitlines() if part.strip()]
    keys = [part.split(":", 1)[1].strip() for part in lines if part.startswith("full_key:")]
    what = lines[0] if lines else type(error).__name__
    return f"{keys[0]}: {what}" if keys else what


def to_yaml(stored: SavedConfig) -> str:
    """Return every option of a run as YAML, with defaults, to resume or repeat the run from."""
    body = asdict(stored.config) | {"resume": None, "repeat": None}
    return yaml.safe_dump({MADE_WITH: stored.made_with} | body, sort_keys=False)


def parse_saved(text: str, where: str) -> SavedConfig:
    """Parse a stored configuration.

    Args:
      text: the content of the file.
      where: the name of the source, for error messages.

    Raises:
      ConfigError: the text is not a configuration.
    """
    try:
        found = yaml.load(text, NoAliasLoader)  # a safe loader: it creates only plain data
        if not isinstance(found, dict):
            raise ConfigError("it is not a configuration")
        made_with = found.pop(MADE_WITH, {})
        if not isinstance(made_with, dict):
            raise ConfigError(f"{MADE_WITH} is not a list of versions")
        if "${" in str(found):
            raise ConfigError("it holds a reference ('${'); stored values must be literal")
        found = whole_numbers(rename_earlier(found))
        config = OmegaConf.to_object(OmegaConf.merge(config_schema(), found))
    except Exception as error:  # an untrusted file may cause any exception
        raise ConfigError(f"{where} cannot be read: {innermost_reason(error)}") from None
    assert isinstance(config, Config)
    return SavedConfig(config, {str(name): str(version) for name, version in made_with.items()})


def whole_numbers(found: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return stored options with each whole number written as one: YAML reads 1e6 as a text.

    Args:
      found: the options, by name.
      prefix: the name of the group that they are in, with a dot.
    """
    kinds = {name: entry.type for name, entry in config_options()}
    made = dict(found)
    for name, value in found.items():
        if isinstance(value, dict) and f"{prefix}{name}" not in kinds:
            made[name] = whole_numbers(value, f"{prefix}{name}.")
        elif kinds.get(f"{prefix}{name}") is int and isinstance(value, float | str):
            with suppress(ValueError):  # else it is refused with the name of the option
                made[name] = whole_number(value if isinstance(value, str) else str(value))
    return made


def read_saved(path: Path) -> SavedConfig:
    """Read a stored configuration from its file.

    Raises:
      ConfigError: the file cannot be read, or is not a configuration.
    """
    try:
        return parse_saved(path.read_text(), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} cannot be read: {error}") from None


def check_code(stored: Config, overrides: dict[str, Override], what: str) -> None:
    """Check that the command line repeats all code that a stored configuration names.

    Args:
      stored: the stored configuration.
      overrides: the options of the command line, by key.
      what: the option that names the stored run, for error messages.

    Raises:
      ConfigError: the stored configuration names code that the command line does not name.
    """
    named = code_options(stored)
    missing = [one for one in named if one.partition("=")[0] not in overrides]
    if missing:
        kinds = {"algo.module": "uses a custom module", "env.id": "has a task in a Python module"}
        reason = " and ".join(kinds[one.partition("=")[0]] for one in missing)
        raise ConfigError(
            f"{what}: this run {reason}; for safety repeat "
            f"{' '.join(map(shell_text, missing))} on the command line, if you trust it"
        )


def apply_overrides(stored: Config, overrides: dict[str, Override], what: str) -> Config:
    """Return the stored configuration with the options of the command line applied.

    The options may only repeat the stored configuration, or extend the run; the options in
    `CHANGEABLE` may differ.

    Args:
      stored: the stored configuration.
      overrides: the options of the command line, by key.
      what: the option that names the stored run, for error messages.

    Raises:
      ConfigError: an option differs from the stored configuration; the message names the first.
    """
    check_code(stored, overrides, what)
    stored = validate_config(stored)
    values = OmegaConf.create(asdict(stored))
    changed = {}
    for key, override in overrides.items():
        if key == "preset":
            raise ConfigError(f"{what}: a stored run already has its settings; leave preset out")
        was, now = (
            OmegaConf.select(values, f"{key}.name" if key in NAMED_GROUPS else key),
            override.value(),
        )
        if key == "env" and now in GENERIC_ENVS:
            continue
        if key == "algo" and now == "module" and stored.algo.module is not None:
            continue
        if key in CHANGEABLE:
            changed[key] = now
        elif was != now:
            raise ConfigError(f"{what}: the run has {key}={was}, not {now}")
    try:
        config = OmegaConf.to_object(OmegaConf.merge(config_schema(), values, changed))
    except OmegaConfBaseException as error:
        raise ConfigError(f"{what}: {innermost_reason(error)}") from None
    assert isinstance(config, Config)
    return check_extension(stored, config, what)


def check_extension(stored: Config, config: Config, what: str) -> Config:
    """Return the validated configuration; it may not be shorter than the stored one.

    Args:
      stored: the stored configuration.
      config: the new configuration.
      what: the option that names the stored run, for error messages.

    Raises:
      ConfigError: the new configuration is invalid, or has fewer steps than the stored one.
    """
    config = validate_config(config)
    if config.total_steps < stored.total_steps:
        raise ConfigError(
            f"{what}: the run has total_steps={stored.total_steps}; "
            "it can be extended, not shortened"
        )
    anneals = config.ppo.anneal_learning_rate or config.algo.anneal_learning_rate
    if anneals and config.iterations != stored.iterations:
        raise ConfigError(
            f"{what}: the learning rate falls to 0 over total_steps={stored.total_steps}; a run "
            "that anneals cannot be extended"
        )
    return config


def load_resumed(overrides: dict[str, Override]) -> Config:
    """Return the configuration of the run to resume.

    Raises:
      ConfigError: the directory holds no run, or the options do not fit the run.
    """
    directory = str(overrides.pop("resume").value())
    path = Path(directory) / CONFIG
    if not is_file(path):
        raise ConfigError(f"resume={directory}: there is no run (no {CONFIG})")
    if "run_dir" in overrides:
        raise ConfigError("resume already names the run directory; leave run_dir out")
    config = apply_overrides(read_saved(path).config, overrides, "resume")
    return replace(config, resume=directory, run_dir=directory)


def load_resumed_or_new(config: Config) -> Config:
    """Return the configuration for `resume=auto`: the run in `run_dir`, or a new run there.

    Raises:
      ConfigError: `run_dir` is not given, or it holds a run of another configuration.
    """
    if config.run_dir is None:
        raise ConfigError("resume=auto needs run_dir=DIRECTORY")
    path = Path(config.run_dir) / CONFIG
    if not is_file(path):
        return replace(config, resume=None)
    stored = validate_config(read_saved(path).config)
    before, wanted = run_settings(stored), run_settings(config)
    for name, now in wanted.items():
        was = before.get(name, now if name.startswith("module.") else None)
        if was != now:
            raise ConfigError(
                f"resume=auto: the run in {config.run_dir} has {name}={was}, not {now}"
            )
    return check_extension(stored, replace(config, resume=config.run_dir), "resume=auto")


def load_repeated(overrides: dict[str, Override]) -> Config:
    """Return the configuration of a run that is repeated in a separate directory.

    Raises:
      ConfigError: the file does not exist, or the options do not fit the run.
    """
    path = Path(str(overrides.pop("repeat").value()))
    if "resume" in overrides:
        raise ConfigError("repeat starts a new run, resume continues one; give only one of them")
    run_dir = overrides.pop("run_dir", None)
    if "total_steps" in overrides:
        raise ConfigError("repeat: total_steps is that of the run; leave it out")
    if not is_file(path):
        raise ConfigError(f"repeat={path}: there is no such file; give the {CONFIG} of a run")
    config = apply_overrides(read_saved(path).config, overrides, "repeat")
    where = None if run_dir is None else str(run_dir.value())
    return replace(config, repeat=str(path), resume=None, run_dir=where)
