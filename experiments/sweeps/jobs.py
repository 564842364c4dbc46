"""The jobs of a sweep: their names, their overrides, their files.

The run of a job is <sweep>/<name>; its record and log are <sweep>/cells/<name>.json and .log.
"""

import json
from collections import Counter
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException

from ..config.command_text import option_text
from ..config.compose import load_config, preset_arguments
from ..config.earlier_options import rename_argument
from ..config.overrides import normalize_overrides
from ..config.run_settings import CHANGEABLE
from ..config.saved import CONFIG
from ..config.validation import group_choices, unknown_name_error
from ..system.display import ProgressBars
from ..system.errors import ConfigError, one_line
from ..system.files import safe_file_name, write_atomically

FILES = "cells"  # the folder has the name from earlier versions, for their sweeps
SWEEP_OWNED = ("run_dir", "resume", "repeat")  # a sweep sets these itself
NAME_KEYS = ("env", "env.id", "algo", "algo.module", "seed")  # keys that are always in a job's name
FEW = 20  # so many jobs are checked without a progress bar
MANY_SEEDS = 1 << 30  # seeds below it are valid with any other settings


class Job(NamedTuple):
    """One run of a sweep."""

    name: str  # <env>/<algo>/<seed>, and the other swept keys after it
    overrides: list[str]  # the arguments of `sndjax run`
    total: int  # steps per seed
    problem: str | None  # why the job cannot run


def expand_jobs(arguments: Sequence[str]) -> list[Job]:
    """Return the validated jobs of a command line whose keys may have several values.

    Raises:
      ConfigError: the command line cannot be read, or two jobs would have one directory.
    """
    keys = swept_keys(arguments)
    with ProgressBars() as bars:
        everything = [normalize_overrides(one) for one in expand_product(arguments)]
        listed = bars.track("checking jobs", everything) if len(everything) > FEW else everything
        jobs = [make_job(job_name(one, keys), one) for one in listed]
    names = Counter(job.name for job in jobs)
    for name, count in names.items():
        if count > 1:
            raise ConfigError(f"{count} jobs would all be {name}")
    return jobs


def expand_product(arguments: Sequence[str]) -> list[list[str]]:
    """Return every combination of the values, in the order of Hydra's basic sweeper.

    Raises:
      ConfigError: the command line cannot be read, or has values that only a search accepts.

    >>> expand_product(["env=Venture", "seed=0,9"])
    [['env=Venture', 'seed=0'], ['env=Venture', 'seed=9']]
    """
    try:
        (batch,) = BasicSweeper.split_arguments(list(parse_sweep(arguments).values()), None)
    except HydraException as error:
        raise ConfigError(
            f"{str(error).splitlines()[0]}; only a search (hydra/sweeper=optuna) accepts this"
        ) from None
    return batch


def split_hydra_arguments(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split a command line into our options and Hydra's.

    Raises:
      ConfigError: an argument is not key=value, or there is no such sweep.
    """
    left = [argument for argument in arguments if argument not in ("-m", "--multirun")]
    hydras = [a for a in left if a.lstrip("+~").startswith(("hydra", "sweep="))]
    for argument in left:
        if "=" not in argument:
            raise ConfigError(f"cannot read '{argument}': write key=value")
        name = argument.removeprefix("sweep=")
        if name != argument and name not in group_choices("sweep"):
            raise unknown_name_error("sweep", name, group_choices("sweep"))
    return [argument for argument in left if argument not in hydras], hydras


def parse_sweep(arguments: Sequence[str]) -> dict[str, Override]:
    """Return the overrides of a sweep by key; for a repeated key, the last.

    Raises:
      ConfigError: the arguments cannot be read, or set a key that the sweep sets itself.
    """
    try:
        found = OverridesParser.create().parse_overrides(list(arguments))
    except HydraException as error:
        raise ConfigError(f"cannot read the sweep: {str(error).splitlines()[0]}") from None
    overrides = {override.get_key_element(): override for override in found}
    for key in SWEEP_OWNED:
        if key in overrides:
            raise ConfigError(
                f"{key}: a sweep chooses the directories of its runs; use hydra.sweep.dir=DIR"
            )
    return overrides


def swept_keys(arguments: Sequence[str]) -> tuple[str, ...]:
    """Return the keys that have several values.

    Raises:
      ConfigError: see `parse_sweep`.
    """
    return tuple(
        k for k, override in parse_sweep(arguments).items() if override.is_sweep_override()
    )


def make_job(name: str, overrides: Sequence[str]) -> Job:
    """Make a job, with the reason why it cannot run if its configuration is not valid."""
    given = parse_sweep(overrides).get("seed")
    seed: Any = 0 if given is None else given.value()
    plain = type(seed) is int and 0 <= seed < MANY_SEEDS
    others = [override for override in overrides if not (plain and override.startswith("seed="))]
    return Job(name, list(overrides), *validate_overrides(tuple(others)))


@lru_cache(1 << 14)  # composing a configuration takes a tenth of a second
def validate_overrides(overrides: tuple[str, ...]) -> tuple[int, str | None]:
    """Return the steps per seed of a configuration, and the error message if it is invalid."""
    try:
        config = load_config(list(overrides))
    except ConfigError as error:
        return 0, one_line(error)
    return config.iterations * config.rows, None


def job_name(overrides: Sequence[str], swept: Sequence[str]) -> str:
    """Return the name of a job, which is also its directory within the sweep.

    >>> job_name(["env=Venture", "algo=rnd", "seed=9", "algo.eta=0.5"], ["seed", "algo.eta"])
    'Venture/rnd/9,algo.eta=0.5'
    """
    join = lambda value: "-".join(map(str, value)) if isinstance(value, list) else str(value)
    values = {key: join(override.value()) for key, override in parse_sweep(overrides).items()}
    if "preset" in values and "algo" not in values:
        values |= dict(word.partition("=")[::2] for word in preset_arguments(values["preset"]))
    env = values.get("env.id", values.get("env", "unnamed"))
    algo = values.get("algo.module", values.get("algo", "unnamed")).rpartition(":")[2]
    others = [f"{key}={quote(values[key], safe='')}" for key in swept if key not in NAME_KEYS]
    return "/".join(
        (
            safe_file_name(env),
            safe_file_name(algo),
            ",".join([safe_file_name(values.get("seed", "0")), *others]),
        )
    )


def find_conflict(directory: Path, job: Job, before: Job | None) -> str | None:
    """Return the error message if a job's directory holds another job's run, or None.

    Args:
      directory: the directory of the sweep.
      job: the job.
      before: the job that was recorded before with this name, if any.
    """
    place = directory / job.name
    free = lambda own: sorted(o for o in own if o.partition("=")[0].lstrip("+") not in CHANGEABLE)
    same = before is not None and free(before.overrides) == free(job.overrides)
    if same or not (place / CONFIG).is_file():
        return None
    try:
        load_config([*job.overrides, option_text("run_dir", place), "resume=auto"])
    except ConfigError as error:
        return one_line(error)
    return None


def job_file(directory: Path, name: str, kind: str) -> Path:
    """Return the path of a job's record or log.

    Args:
      directory: the directory of the sweep.
      name: the name of the job.
      kind: "json" or "log".
    """
    return directory / FILES / f"{name}.{kind}"


def write_job(directory: Path, job: Job, **more: Any) -> None:
    """Write the record of a job, with the data of its last run as `more`."""
    path = job_file(directory, job.name, "json")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps(job._asdict() | more) + "\n")


def read_job(path: Path) -> tuple[Job, dict[str, Any]]:
    """Return a recorded job, and the data of its last run.

    Raises:
      ConfigError: the file is not the record of a job.
    """
    try:
        entry = json.loads(path.read_text())
        job = Job(*(entry.pop(field) for field in Job._fields))
        return job._replace(overrides=[rename_argument(one) for one in job.overrides]), entry
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise ConfigError(f"{path}: this file describes no job of a sweep") from None


def read_jobs(directory: Path) -> list[tuple[Job, dict[str, Any]]]:
    """Return every recorded job of a sweep, and the data of its last run.

    Raises:
      ConfigError: the directory holds no sweep, or a file is not the record of a job.
    """
    found = [read_job(path) for path in sorted((directory / FILES).rglob("*.json"))]
    if not found:
        raise ConfigError(f"{directory}: there is no sweep here")
    return found
