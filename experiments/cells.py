"""The cells of a sweep: their names, their files, and how far each of them is.

A cell's run is <sweep>/<name>, its own files are <sweep>/cells/<name>.json and .log. Whoever runs
a cell holds a lock on its log, which the kernel takes back with the process.
"""

import fcntl
import json
import os
import re
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException

from experiments.config import load
from experiments.directory import replace
from experiments.options import ConfigError
from experiments.progress import Bars
from experiments.stored import CONFIG, FREE
from experiments.validate import choices, unknown

FILES = "cells"
PLACED = ("run_dir", "resume", "repeat")  # a sweep says these itself
NAMING = ("env", "env.id", "algo", "algo.module", "seed")  # what stands in a cell's name anyway
FEW = 20  # cells that are checked in a moment
MANY_SEEDS = 1 << 30  # so far a seed is fine whatever else is said
DONE, RUNNING, STOPPED, FAILED, WAITING = STATES = (
    "done",
    "running",
    "stopped",
    "failed",
    "waiting",
)


class Cell(NamedTuple):
    """One run of a sweep."""

    name: str  # <env>/<algo>/<seed>, and the other swept keys after it
    overrides: list[str]  # what `experiments.run` is told
    total: int  # steps per seed
    problem: str | None  # why it cannot run


class Standing(NamedTuple):
    """How far a cell is."""

    cell: Cell
    state: str  # one of STATES
    step: int  # per seed
    last100: float | None  # the mean over seeds of the return of the last 100 episodes
    reason: str  # of a failure


def expanded(arguments: Sequence[str]) -> list[Cell]:
    """The cells that a command line with several values stands for, each looked at.

    Raises:
      ConfigError: it cannot be read, or two cells would have one directory.
    """
    keys = swept(arguments)
    with Bars() as bars:
        everything = product(arguments)
        listed = bars.over("checking cells", everything) if len(everything) > FEW else everything
        cells = [checked(name_of(one, keys), one) for one in listed]
    names = Counter(cell.name for cell in cells)
    for name, count in names.items():
        if count > 1:
            raise ConfigError(f"{count} cells would all be {name}")
    return cells


def product(arguments: Sequence[str]) -> list[list[str]]:
    """Every combination of the values, as Hydra's own sweeper makes them.

    >>> product(["env=Venture", "seed=0,9"])
    [['env=Venture', 'seed=0'], ['env=Venture', 'seed=9']]
    """
    try:
        (batch,) = BasicSweeper.split_arguments(list(parsed(arguments).values()), None)
    except HydraException as error:
        raise ConfigError(f"{str(error).splitlines()[0]}; a search takes them") from None
    return batch


def divided(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """The arguments that are our options, and those that are Hydra's."""
    left = [argument for argument in arguments if argument not in ("-m", "--multirun")]
    hydras = [a for a in left if a.lstrip("+~").startswith(("hydra", "sweep="))]
    for argument in left:
        if "=" not in argument:
            raise ConfigError(f"cannot read '{argument}': write key=value")
        name = argument.removeprefix("sweep=")
        if name != argument and name not in choices("sweep"):
            raise unknown("sweep", name, choices("sweep"))
    return [argument for argument in left if argument not in hydras], hydras


def parsed(arguments: Sequence[str]) -> dict[str, Override]:
    """The overrides of a sweep by key; of a repeated key the last."""
    try:
        found = OverridesParser.create().parse_overrides(list(arguments))
    except HydraException as error:
        raise ConfigError(f"cannot read the sweep: {str(error).splitlines()[0]}") from None
    overrides = {override.get_key_element(): override for override in found}
    for key in PLACED:
        if key in overrides:
            raise ConfigError(f"{key}: a sweep places its runs itself; say hydra.sweep.dir=DIR")
    return overrides


def swept(arguments: Sequence[str]) -> tuple[str, ...]:
    """The keys that have several values."""
    return tuple(k for k, override in parsed(arguments).items() if override.is_sweep_override())


def checked(name: str, overrides: Sequence[str]) -> Cell:
    """A cell, and why it cannot run, as far as that is known before it does."""
    given = parsed(overrides).get("seed")
    seed: Any = 0 if given is None else given.value()
    plain = type(seed) is int and 0 <= seed < MANY_SEEDS
    others = [override for override in overrides if not (plain and override.startswith("seed="))]
    return Cell(name, list(overrides), *looked_at(tuple(others)))


@lru_cache(1 << 14)  # to compose a configuration takes a tenth of a second
def looked_at(overrides: tuple[str, ...]) -> tuple[int, str | None]:
    """The steps per seed that the overrides ask for, and what is wrong with them."""
    try:
        config = load(list(overrides))
    except ConfigError as error:
        return 0, " ".join(str(error).split())
    return config.iterations * config.rows, None


def name_of(overrides: Sequence[str], swept: Sequence[str]) -> str:
    """The name of a cell, which is its directory within the sweep's.

    >>> name_of(["env=Venture", "algo=rnd", "seed=9", "algo.eta=0.5"], ["seed", "algo.eta"])
    'Venture/rnd/9,algo.eta=0.5'
    """
    values = {key: str(override.value()) for key, override in parsed(overrides).items()}
    plain = lambda text: re.sub(r"[^A-Za-z0-9_.-]", "-", text).lstrip(".") or "unnamed"
    env = values.get("env.id", values.get("env", "unnamed"))
    algo = values.get("algo.module", values.get("algo", "unnamed")).rpartition(":")[2]
    others = [f"{key}={quote(values[key], safe='')}" for key in swept if key not in NAMING]
    return "/".join((plain(env), plain(algo), ",".join([plain(values.get("seed", "0")), *others])))


def conflict(directory: Path, cell: Cell, before: Cell | None) -> str | None:
    """Why what is in a cell's directory is not of this cell, if it is not."""
    place = directory / cell.name
    free = lambda own: sorted(o for o in own if o.partition("=")[0].lstrip("+") not in FREE)
    known = before is not None and free(before.overrides) == free(cell.overrides)
    if known or not (place / CONFIG).is_file():
        return None
    try:
        load([*cell.overrides, f"run_dir={quoted(place)}", "resume=auto"])
    except ConfigError as error:
        return " ".join(str(error).split())
    return None


def quoted(path: Path) -> str:
    """A path as a value of an override."""
    return "'" + str(path).replace("'", "\\'") + "'"


def file_of(directory: Path, name: str, kind: str) -> Path:
    """Where a cell's own file is: `json` or `log`."""
    return directory / FILES / f"{name}.{kind}"


def write(directory: Path, cell: Cell, **more: Any) -> None:
    """Keep a cell, with what is known of its last run."""
    path = file_of(directory, cell.name, "json")
    path.parent.mkdir(parents=True, exist_ok=True)
    replace(path, json.dumps(cell._asdict() | more) + "\n")


def recorded(path: Path) -> tuple[Cell, dict[str, Any]]:
    """A cell with what is known of its last run.

    Raises:
      ConfigError: the file is none of ours.
    """
    try:
        entry = json.loads(path.read_text())
        return Cell(*(entry.pop(field) for field in Cell._fields)), entry
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise ConfigError(f"{path} is no cell of a sweep") from None


def known(directory: Path) -> list[tuple[Cell, dict[str, Any]]]:
    """Every cell of a sweep with what is known of its last run.

    Raises:
      ConfigError: there is no sweep here.
    """
    found = [recorded(path) for path in sorted((directory / FILES).rglob("*.json"))]
    if not found:
        raise ConfigError(f"{directory}: there is no sweep here")
    return found


@contextmanager
def held(directory: Path, name: str, patience: float = 0.0) -> Iterator[int | None]:
    """Hold a cell; its log, open, or None where another process still holds it after a while.

    A run whose waiting worker was killed holds it, too, until it has written its checkpoint.
    """
    path = file_of(directory, name, "log")
    path.parent.mkdir(parents=True, exist_ok=True)
    log = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
    end = time.monotonic() + patience
    try:
        while not locked(log, fcntl.LOCK_EX):
            if time.monotonic() >= end:
                yield None
                return
            time.sleep(0.5)
        yield log
    finally:
        os.close(log)


def locked(file: int, kind: int) -> bool:
    """Whether the lock could be had at once."""
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        raise ConfigError(
            f"this file system has no locks, and a sweep needs them: {error}"
        ) from None
    return True


def is_held(directory: Path, name: str) -> bool:
    """Whether a process runs the cell."""
    try:
        with file_of(directory, name, "log").open() as log:
            return not locked(log.fileno(), fcntl.LOCK_SH)
    except FileNotFoundError:
        return False


def standing(directory: Path, cell: Cell, last: dict[str, Any]) -> Standing:
    """How far a cell is, by its run directory, its lock and what its last run ended with."""
    line = last_line(directory / cell.name / "metrics.jsonl")
    steps, last100 = figure(directory / cell.name, "last100_ext_return")
    step = max(steps, int(line.get("step", 0)))
    reason = str(last.get("reason", ""))
    if cell.problem is not None:
        return Standing(cell, FAILED, step, last100, cell.problem)
    if steps >= cell.total:
        return Standing(cell, DONE, step, last100, "")
    if is_held(directory, cell.name):
        return Standing(cell, RUNNING, step, line.get("last100_ext_return"), "")
    if last.get("status") in (None, 0, 130, 143):  # 0: it was shorter then
        state = STOPPED if step or "pid" in last else WAITING
        return Standing(cell, state, step, last100, "")
    return Standing(cell, FAILED, step, last100, reason)


def survey(directory: Path) -> list[Standing]:
    """How far every cell of a sweep is."""
    return [standing(directory, cell, last) for cell, last in known(directory)]


def figure(run: Path, name: str) -> tuple[int, float | None]:
    """The steps per seed of a run's last summary, and the mean over seeds of one of its figures."""
    try:
        seeds = json.loads((run / "summary.json").read_text())["seeds"]
        values = [seed[name] for seed in seeds if seed[name] is not None]
        return min(seed["steps"] for seed in seeds), sum(values) / len(values) if values else None
    except (OSError, ValueError, KeyError, TypeError):
        return 0, None


def last_line(path: Path, size: int = 1 << 16) -> dict[str, Any]:
    """The last complete object of a log; empty where there is none."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - size))
            lines = file.read().split(b"\n")[:-1]
        return json.loads(lines[-1])
    except (OSError, ValueError, IndexError):
        return {}
