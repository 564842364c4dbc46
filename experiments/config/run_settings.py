"""The settings that make a run what it is, and may not change when it is resumed."""

from typing import Any

from .cell_options import cell_options
from .earlier_options import flatten, rename_settings
from .schema import Config
from .validation import NAMED_GROUPS, config_options, get_option

# Options that may change when a run is resumed.
CHANGEABLE = ["total_steps", "resume", "repeat", "run_dir", "tracker", "group", "distributed"]
CHANGEABLE += ["iterations_per_call", "cores"]


def run_settings(config: Config) -> dict[str, Any]:
    """Return every option that may not change when a run is resumed, by its dotted name."""
    names = [f"{group}.name" for group in NAMED_GROUPS]
    names += [name for name, _ in config_options() if name not in CHANGEABLE]
    found = {name: get_option(config, name) for name in names}
    return flatten(found, keep=("env.options", "env.eta"))


def check_settings(config: Config, stored: dict[str, Any]) -> None:
    """Raise ValueError for the first setting that differs from the stored configuration.

    An option that is newer than the checkpoint counts as stored with its default.

    Raises:
      ValueError: a setting differs; the message names it with both values.
    """
    stored = rename_settings(stored)
    own = {**dict(config_options()), **cell_options(config.algo)}
    defaults = {name: entry.default for name, entry in own.items()} | {"network.name": "thesis"}
    for name, now in run_settings(config).items():
        was = stored.get(name, defaults.get(name))
        if was != now:
            raise ValueError(f"{name} was {was}, is {now}")
