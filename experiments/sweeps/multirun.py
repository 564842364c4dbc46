"""Sweeps by Hydra's multirun: `sndjax -m env=A,B algo=C,D seed=0,9`.

All jobs of a sweep are checked before the first starts. Hydra's launcher runs the valid jobs that
are not finished, each in a separate process.
"""

import os
import signal
import sys
import zlib
from collections.abc import Sequence
from contextlib import redirect_stderr, suppress
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

from hydra import compose, initialize_config_dir
from hydra import main as hydra_main
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from ..config.command_text import SWEEP_DIR, option_text, sweep_command
from ..config.compose import register_configs
from ..config.run_settings import CHANGEABLE
from ..config.saved import innermost_reason
from ..config.validation import CONF
from ..reporting.run_report import write_report
from ..system.errors import ConfigError, print_error
from .job_runner import (
    FAILURE_PREFIX,
    SEARCH_METRIC,
    STOP_FILE,
    JobRunner,
    launcher_resources,
    visible_gpus,
)
from .job_status import (
    DONE,
    FAILED,
    RUNNING,
    STATES,
    STOPPED,
    WAITING,
    JobStatus,
    job_status,
    job_statuses,
)
from .jobs import (
    FILES,
    Job,
    expand_jobs,
    find_conflict,
    read_jobs,
    split_hydra_arguments,
    swept_keys,
    write_job,
)
from .live_table import LiveTable, status_table
from .search import search_report

READY = (STOPPED, FAILED, WAITING)
PLUGINS = {"ray": "ray", "submitit_slurm": "slurm", "submitit_local": "slurm", "optuna": "optuna"}


def compose_hydra(hydras: list[str]) -> DictConfig:
    """Return Hydra's configuration of a sweep.

    Raises:
      ConfigError: Hydra refuses one of the overrides.
    """
    register_configs()
    try:
        with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
            return compose("multirun", overrides=hydras, return_hydra_config=True).hydra
    except (HydraException, OmegaConfBaseException) as error:
        missing = [n for n in PLUGINS if any(a.endswith(f"={n}") for a in hydras)]
        absent = missing and "not find" in str(error)
        hint = f" (pip install '.[{PLUGINS[missing[0]]}]')" if absent else ""
        raise ConfigError(f"{innermost_reason(error)}{hint}") from None


def default_directory(own: list[str], hydras: list[str]) -> Path:
    """Return the default directory of a sweep, which differs for each command line."""
    named = [a.removeprefix("sweep=") for a in hydras if a.startswith("sweep=")]
    mine = [a for a in own if a.partition("=")[0] not in CHANGEABLE]
    digest = zlib.crc32("\n".join([*named, *mine]).encode())
    words = named[:1] if named and not mine else [*named, f"{digest:08x}"]
    return Path("runs/sweeps") / "-".join(words)


class Sweep(NamedTuple):
    """A sweep, as a command line describes it.

    Attributes:
      directory: the directory of the sweep.
      params: the values that the sweep's configuration lists.
      own: our options on the command line.
      hydras: Hydra's options on the command line.
      hydra: Hydra's configuration.
      is_search: whether a sweeper other than Hydra's basic one chooses the values.
    """

    directory: Path
    params: list[str]
    own: list[str]
    hydras: list[str]
    hydra: DictConfig
    is_search: bool


def parse_command(arguments: Sequence[str]) -> Sweep:
    """Return the sweep that a command line describes.

    Raises:
      ConfigError: Hydra cannot read the command line, or PYTHONOPTIMIZE is set.
    """
    if not __debug__:
        raise ConfigError(
            "Hydra reads sweeps by way of asserts: unset PYTHONOPTIMIZE, and give "
            "+hydra.job.env_set.PYTHONOPTIMIZE=1 for the sweep's runs to have it"
        )
    own, hydras = split_hydra_arguments(arguments)
    hydra = compose_hydra(hydras)
    directory = Path(hydra.sweep.dir or default_directory(own, hydras)).resolve()
    params = [f"{key}={value}" for key, value in (hydra.sweeper.get("params") or {}).items()]
    is_search = not hydra.sweeper._target_.endswith(".BasicSweeper")
    return Sweep(directory, params, own, hydras, hydra, is_search)


def multirun(arguments: Sequence[str]) -> int:
    """Run the unfinished jobs of a sweep, and return the exit status.

    It is 0 if all jobs are done, 1 if jobs or the launcher failed, 130 or 143 if interrupted.

    Raises:
      ConfigError: the command line cannot be read, or no job can run.
    """
    sweep = parse_command(arguments)
    directory = sweep.directory
    given = [*sweep.hydras, option_text(SWEEP_DIR, directory)]
    (directory / STOP_FILE).unlink(missing_ok=True)
    before: list[JobStatus] | None = None  # not known for a search
    swept: tuple[str, ...] = ()
    if sweep.is_search:
        asked, swept = sweep.own, swept_keys([*sweep.params, *sweep.own])
    else:
        before = prepare_jobs(directory, expand_jobs([*sweep.params, *sweep.own]))
        left = [s.job.name for s in before if s.state in READY and not s.job.problem]
        if not left:
            return summarize(directory, before)
        given.append("hydra.sweeper.params=null")
        asked = ["+job=" + ",".join(f"'{name}'" for name in left)]
    gpus = visible_gpus() if "n_jobs" in sweep.hydra.launcher else ()
    more, threads = launcher_resources(sweep.hydra.launcher, gpus)
    runner = JobRunner(
        directory=str(directory),
        start=os.getcwd(),
        starter=os.getpid(),
        swept=swept,
        threads=threads,
        gpus=gpus,
    )
    with LiveTable(directory), GracefulStop(directory / STOP_FILE) as stop:
        trouble = launch(runner, ["-m", *given, *more, *asked])
    if sweep.is_search and not stop.status and not trouble:
        print(search_report(directory, swept, SEARCH_METRIC))
    status = summarize(directory, before)
    if stop.status:
        print("interrupted; to resume, give the same command:", sweep_command(arguments, directory))
        return stop.status
    if trouble:
        return print_error(f"the launcher gave up: {trouble}", 1)
    return status


def summarize(directory: Path, before: list[JobStatus] | None) -> int:
    """Print the state of the jobs, write the page, and return 0 if all requested jobs are done."""
    has_jobs = (directory / FILES).is_dir()  # a search has no jobs at first
    found = {s.job.name: s for s in (job_statuses(directory) if has_jobs else [])}
    bad = {s.job.name: s for s in before or () if s.job.problem}
    names = found if before is None else [s.job.name for s in before]
    statuses = [(found | bad)[name] for name in names]
    print(status_table(statuses))
    if any(s.step for s in statuses):
        write_page(directory)
    return 0 if statuses and all(s.state == DONE for s in statuses) else 1


def write_page(directory: Path) -> None:
    """Write the page about the runs of the jobs so far."""
    with suppress(ConfigError):  # nothing to show yet
        write_report([directory], directory / "report")


def prepare_jobs(directory: Path, listed: list[Job]) -> list[JobStatus]:
    """Record the jobs of a sweep, and return the state of each before anything runs.

    Raises:
      ConfigError: no job can run.
    """
    if all(job.problem for job in listed):
        raise ConfigError(listed[0].problem)
    there = read_jobs(directory) if (directory / FILES).is_dir() else []
    before = {job.name: (job, last) for job, last in there}
    now = []
    for job in listed:
        known, last = before.get(job.name, (None, {}))
        if job.problem is None and (other := find_conflict(directory, job, known)):
            job = job._replace(problem=other)  # the existing run is not changed
        now.append(current := job_status(directory, job, last))
        at_work = current.state in (RUNNING, DONE)
        if known is None or not (at_work or job.problem):
            write_job(directory, job, **last)
    print_prepared(directory, now)
    return now


def print_prepared(directory: Path, statuses: list[JobStatus]) -> None:
    """Print how many jobs are in each state before anything runs, and which cannot run.

    Args:
      directory: the directory of the sweep.
      statuses: the states of its jobs.
    """
    words = {
        DONE: "done already",
        RUNNING: "running elsewhere",
        STOPPED: "to resume",
        FAILED: "failed before, to try again",
        WAITING: "new",
    }
    bad = [s for s in statuses if s.job.problem]
    fine = [s for s in statuses if not s.job.problem]
    counts = {state: [s for s in fine if s.state == state] for state in STATES}
    parts = [f"{len(found)} {words[state]}" for state, found in counts.items() if found]
    parts += [f"{len(bad)} that cannot run"] if bad else []
    print(f"{directory}: {len(statuses)} jobs: {', '.join(parts)}")
    for one in bad:
        print(f"cannot run: {one.job.name}: {one.reason}")
    for state in (STOPPED, FAILED):
        for one in counts[state]:
            print(f"{words[state]}: {one.job.name}{f': {one.reason}' if one.reason else ''}")


def launcher_error(lines: list[str]) -> str:
    """Return the last lines of a launcher's output; "" if they are the failure of one job.
    >>> launcher_error(["joblib.externals.loky.BrokenProcessPool: a worker died"])
    'joblib.externals.loky.BrokenProcessPool: a worker died'
    >>> launcher_error(["job env=Venture: not finished", "Set HYDRA_FULL_ERROR=1 for more"])
    ''
    """
    last = [line for line in lines if "HYDRA_FULL_ERROR" not in line][-2:]
    return "" if any(line.startswith(f"{FAILURE_PREFIX} ") for line in last) else " ".join(last)


def launch(runner: JobRunner, arguments: list[str]) -> str:
    """Run the sweep with Hydra; return launcher errors (job failures are shown in the table)."""
    before, complaint, conf = sys.argv, StringIO(), str(CONF.resolve())
    sys.argv, at_once = ["sndjax", *arguments], False
    try:
        with redirect_stderr(complaint):
            hydra_main(version_base="1.3", config_path=conf, config_name="multirun")(runner)()
    except SystemExit as left:
        if left.code:
            lines = [line.strip() for line in complaint.getvalue().splitlines() if line.strip()]
            return launcher_error(lines)
    except KeyboardInterrupt:  # a second signal
        at_once = True
        return "interrupted"
    finally:
        sys.argv = before
        if "joblib" in sys.modules:  # its workers would wait for more jobs
            from joblib.externals.loky import get_reusable_executor

            get_reusable_executor().shutdown(kill_workers=at_once)
    return ""


class GracefulStop:
    """The handler of SIGINT and SIGTERM: no job starts, runs write a checkpoint and stop."""

    def __init__(self, stop: Path):
        """Store the path of the stop file, which a signal creates and the workers look for."""
        self.file, self.status = stop, 0

    def __enter__(self) -> "GracefulStop":
        self.before = {s: signal.signal(s, self.stop) for s in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self.before.items():
            signal.signal(number, handler)

    def stop(self, number: int, frame: Any) -> None:
        """Create the stop file for the workers; a second signal raises KeyboardInterrupt."""
        if self.status:
            raise KeyboardInterrupt
        self.status = 128 + number
        self.file.touch()
