"""python -m experiments.run -m env=A,B algo=C,D seed=0,9: many runs by Hydra's multirun.

The cells of a sweep are checked before the first starts; those that can run and are not finished
are handed to Hydra's launcher, each a process of its own.

    python -m experiments.sweep status DIR    how far each cell of a sweep is
"""

import os
import signal
import sys
import zlib
from collections.abc import Sequence
from contextlib import redirect_stderr, suppress
from io import StringIO
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra import main as hydra_main
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from experiments import cells
from experiments.options import ConfigError
from experiments.overview import Overview, table
from experiments.search import search_report
from experiments.stored import FREE, reason, schema
from experiments.validate import CONF
from experiments.work import FAILED, FIGURE, STOP, Work, gpus_here

READY = (cells.STOPPED, cells.FAILED, cells.WAITING)
MEMORY = 3 << 30  # bytes that a run may take (docs/results/speed.md)
PLUGINS = {"ray": "ray", "submitit_slurm": "slurm", "submitit_local": "slurm", "optuna": "optuna"}


def shares(launcher: DictConfig, gpus: Sequence[str]) -> tuple[list[str], int]:
    """What is still to be said to a launcher, and the threads of each of its cells."""
    cores = len(os.sched_getaffinity(0))
    if "n_jobs" in launcher:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        fitting = len(gpus) or max(1, min(cores, memory // MEMORY))
        jobs = launcher.n_jobs if launcher.n_jobs > 0 else fitting
        return [f"hydra.launcher.n_jobs={jobs}"], max(1, cores // jobs)
    if "ray" in launcher:
        return [], int(launcher.ray.remote.get("num_cpus") or 1)
    return [], int(launcher.get("cpus_per_task") or cores)


def asked_of_hydra(hydras: list[str]) -> DictConfig:
    """Hydra's own configuration of a sweep.

    Raises:
      ConfigError: it refuses what was asked.
    """
    ConfigStore.instance().store(name="schema", node=schema())
    try:
        with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
            return compose("multirun", overrides=hydras, return_hydra_config=True).hydra
    except (HydraException, OmegaConfBaseException) as error:
        missing = [n for n in PLUGINS if any(a.endswith(f"={n}") for a in hydras)]
        absent = missing and "not find" in str(error)
        hint = f" (pip install '.[{PLUGINS[missing[0]]}]')" if absent else ""
        raise ConfigError(f"{reason(error)}{hint}") from None


def default_directory(own: list[str], hydras: list[str]) -> Path:
    """Where a sweep goes that names no place: the same command, the same place."""
    named = [a.removeprefix("sweep=") for a in hydras if a.startswith("sweep=")]
    mine = [a for a in own if a.partition("=")[0] not in FREE]
    if named and not mine:
        return Path("runs/sweeps") / named[0]
    digest = zlib.crc32("\n".join([*named, *mine]).encode())
    return Path("runs/sweeps") / f"{'-'.join([*named, f'{digest:08x}'])}"


def multirun(arguments: Sequence[str]) -> int:
    """Run a sweep, or what is left of it; the exit status.

    0 all cells are done; 1 some failed, or the launcher did; 130 and 143 interrupted.

    Raises:
      ConfigError: nothing of it can run.
    """
    if not __debug__:
        raise ConfigError(
            "Hydra reads sweeps by way of asserts: unset PYTHONOPTIMIZE, and say "
            "+hydra.job.env_set.PYTHONOPTIMIZE=1 for the sweep's runs to have it"
        )
    own, hydras = cells.divided(arguments)
    hydra = asked_of_hydra(hydras)
    directory = Path(hydra.sweep.dir or default_directory(own, hydras)).resolve()
    params = [f"{key}={value}" for key, value in (hydra.sweeper.get("params") or {}).items()]
    given = [*hydras, f"hydra.sweep.dir={cells.quoted(directory)}"]
    search = not hydra.sweeper._target_.endswith(".BasicSweeper")
    (directory / STOP).unlink(missing_ok=True)
    before: list[cells.Standing] | None = None  # of a search it is not known
    swept: tuple[str, ...] = ()
    if search:
        asked, swept = own, cells.swept([*params, *own])
    else:
        before = begun(directory, cells.expanded([*params, *own]))
        left = [s.cell.name for s in before if s.state in READY and not s.cell.problem]
        if not left:
            return concluded(directory, before)
        given.append("hydra.sweeper.params=null")
        asked = ["+cell=" + ",".join(f"'{name}'" for name in left)]
    gpus = gpus_here() if "n_jobs" in hydra.launcher else ()
    more, count = shares(hydra.launcher, gpus)
    work = Work(str(directory), os.getcwd(), os.getpid(), swept, count, gpus)
    with Overview(directory), Stopper(directory / STOP) as stopper:
        trouble = launched(work, ["-m", *given, *more, *asked])
    if search and not stopper.status and not trouble:
        print(search_report(directory, swept, FIGURE))
    status = concluded(directory, before)
    if stopper.status:
        print(f"interrupted; the same command goes on: hydra.sweep.dir={directory}")
        return stopper.status
    if trouble:
        print(f"sndjax: the launcher gave up: {trouble}", file=sys.stderr)
        return 1
    return status


def concluded(directory: Path, before: list[cells.Standing] | None) -> int:
    """Show how the cells stand and write the page; 0 where all that were asked for are done."""
    found = {s.cell.name: s for s in survey(directory)}
    bad = {s.cell.name: s for s in before or () if s.cell.problem}
    names = found if before is None else [s.cell.name for s in before]
    standings = [(found | bad)[name] for name in names]
    print(table(standings))
    if any(s.step for s in standings):
        write_page(directory)
    return 0 if standings and all(s.state == cells.DONE for s in standings) else 1


def survey(directory: Path) -> list[cells.Standing]:
    """How far the cells are; a search has none at first."""
    return cells.survey(directory) if (directory / cells.FILES).is_dir() else []


def write_page(directory: Path) -> None:
    """The page of what the cells have so far."""
    from experiments import report

    out = directory / "report"
    out.mkdir(exist_ok=True)
    with suppress(ConfigError):  # nothing to show yet
        report.write([directory], out, live=False)


def begun(directory: Path, listed: list[cells.Cell]) -> list[cells.Standing]:
    """Keep the cells of a sweep, and say what each stands at before anything runs.

    Raises:
      ConfigError: none of them can.
    """
    if all(cell.problem for cell in listed):
        raise ConfigError(listed[0].problem)
    there = cells.known(directory) if (directory / cells.FILES).is_dir() else []
    before = {cell.name: (cell, last) for cell, last in there}
    now = []
    for cell in listed:
        known, last = before.get(cell.name, (None, {}))
        if cell.problem is None and (other := cells.conflict(directory, cell, known)):
            cell = cell._replace(problem=other)  # what is there stays as it is
        now.append(standing := cells.standing(directory, cell, last))
        at_work = standing.state in (cells.RUNNING, cells.DONE)
        if known is None or not (at_work or cell.problem):
            cells.write(directory, cell, **last)
    words = {
        cells.DONE: "done already",
        cells.RUNNING: "running elsewhere",
        cells.STOPPED: "to go on",
        cells.FAILED: "failed before, to try again",
        cells.WAITING: "new",
    }
    bad = [s for s in now if s.cell.problem]
    fine = [s for s in now if not s.cell.problem]
    counts = {state: [s for s in fine if s.state == state] for state in cells.STATES}
    parts = [f"{len(found)} {words[state]}" for state, found in counts.items() if found]
    parts += [f"{len(bad)} that cannot run"] if bad else []
    print(f"{directory}: {len(listed)} cells: {', '.join(parts)}")
    for one in bad:
        print(f"cannot run: {one.cell.name}: {one.reason}")
    for state in (cells.STOPPED, cells.FAILED):
        for one in counts[state]:
            print(f"{words[state]}: {one.cell.name}{f': {one.reason}' if one.reason else ''}")
    return now


def launched(work: Work, arguments: list[str]) -> str:
    """Hand the sweep to Hydra; what it complained of, except of cells: the table has those."""
    before, complaint, conf = sys.argv, StringIO(), str(CONF.resolve())
    sys.argv, at_once = ["sndjax", *arguments], False
    try:
        with redirect_stderr(complaint):
            hydra_main(version_base="1.3", config_path=conf, config_name="multirun")(work)()
    except SystemExit as left:
        if left.code:
            lines = [line.strip() for line in complaint.getvalue().splitlines() if line.strip()]
            last = [line for line in lines if "HYDRA_FULL_ERROR" not in line][-2:]
            return "" if any(line.startswith(FAILED) for line in last) else " ".join(last)
    except KeyboardInterrupt:  # a second signal
        at_once = True
        return "interrupted"
    finally:
        sys.argv = before
        if "joblib" in sys.modules:  # its workers would wait for more
            from joblib.externals.loky import get_reusable_executor

            get_reusable_executor().shutdown(kill_workers=at_once)
    return ""


class Stopper:
    """SIGINT and SIGTERM stop a sweep in order: no cell begins, runs write a checkpoint and end."""

    def __init__(self, stop: Path):
        """Nothing was asked yet; `stop` is the file that workers look for."""
        self.file, self.status = stop, 0

    def __enter__(self) -> "Stopper":
        self.before = {s: signal.signal(s, self.stop) for s in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self.before.items():
            signal.signal(number, handler)

    def stop(self, number: int, frame: Any) -> None:
        """Tell the workers, wherever they are; a second signal ends the sweep at once."""
        if self.status:
            raise KeyboardInterrupt
        self.status = 128 + number
        self.file.touch()


def main(arguments: list[str]) -> int:
    """`status DIR`; the exit status."""
    from experiments.run import refuse

    if len(arguments) != 2 or arguments[0] != "status":
        print(__doc__)
        return 0 if set(arguments) & {"-h", "--help"} else 2
    try:
        print(table(cells.survey(Path(arguments[1]))))
    except ConfigError as error:
        return refuse(error)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
