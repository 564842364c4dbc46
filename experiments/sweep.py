"""python -m experiments.run -m env=A,B algo=C,D seed=0,9: many runs by Hydra's multirun.

The cells of a sweep are checked before the first starts; those that can run and are not finished
are handed to Hydra's launcher, each a process of its own.

    python -m experiments.sweep status DIR    how far each cell of a sweep is
"""

import os
import shutil
import signal
import subprocess
import sys
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, suppress
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra import main as hydra_main
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException, HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from experiments import cells
from experiments.options import ConfigError
from experiments.overview import Overview, table
from experiments.stored import reason, schema
from experiments.validate import CONF, choices, unknown

FIGURE = "mean_ext_return"  # what a search maximises: it counts how early as well as how often
STOP = "stop"  # a file that keeps queued cells from beginning
PATIENCE = 60.0  # seconds that a run may take to end after its worker was killed
MEMORY = 3 << 30  # bytes that a run may take (docs/results/speed.md)
PLUGINS = {"ray": "ray", "submitit_slurm": "slurm", "submitit_local": "slurm", "optuna": "optuna"}


class CellFailed(CompactHydraException):
    """A cell's run did not finish; raised where it ran, so that its launcher knows."""


@dataclass(frozen=True)
class Work:
    """What a launcher runs: one cell, in a process of its own. Importable, so it can travel."""

    directory: str
    start: str  # the directory that the sweep was started in
    swept: tuple[str, ...]  # the keys that a search gives values to
    threads: int
    gpus: int  # that cells share out among them

    def __call__(self, config: DictConfig) -> float | None:
        """Run the cell that Hydra's job names; the figure that a search goes by.

        Raises:
          CellFailed: why it did not finish.
        """
        directory = Path(self.directory)
        cell = self.cell(directory, config)
        with cells.held(directory, cell.name, PATIENCE) as log:
            if log is None:
                raise CellFailed(f"{cell.name}: another process runs it")
            if (directory / STOP).exists():
                raise CellFailed(f"{cell.name}: not begun, the sweep was interrupted")
            if cell.problem is None:
                self.run(directory, cell, log)
            steps, value = cells.figure(directory / cell.name, FIGURE)
        if cell.problem is not None or steps < cell.total:
            raise CellFailed(f"{cell.name}: {cell.problem or 'not finished'}")
        if self.swept and value is None:
            raise CellFailed(f"{cell.name}: no episode ended, a search has nothing to go by")
        return value

    def cell(self, directory: Path, config: DictConfig) -> cells.Cell:
        """The cell of Hydra's job: one that was listed, or what a search came upon."""
        if name := config.get("cell"):
            return next(cell for cell, _ in cells.known(directory) if cell.name == name)
        overrides, _ = divided(HydraConfig.get().overrides.task)
        GlobalHydra.instance().clear()  # the job's own is not asked again; `load` makes another
        cell = cells.checked(cells.name_of(overrides, self.swept), overrides)
        cells.write(directory, cell)
        return cell

    def run(self, directory: Path, cell: cells.Cell, log: int) -> None:
        """Begin the cell's run or go on with it, and keep how it ended."""
        place = directory / cell.name
        if cells.figure(place, FIGURE)[0] >= cell.total:
            return
        command = [sys.executable, "-m", "experiments.run", *cell.overrides]
        command += [f"run_dir={quoted(place)}", "resume=auto", f"group={quoted(directory)}"]
        if shutil.which("setpriv"):  # so that a run does not outlive the worker that waits for it
            command = ["setpriv", "--pdeathsig", "TERM", *command]
        with self.device(directory) as device:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                cwd=self.start,
                env=os.environ | threads(self.threads) | device,
                start_new_session=True,  # Ctrl-C is for the sweep, which passes it on
            )
            cells.write(directory, cell, pid=process.pid, host=os.uname().nodename)
            status = process.wait()
        last = cells.file_of(directory, cell.name, "log").read_text(errors="replace").splitlines()
        why = {} if status == 0 else {"reason": said(last, status)}
        cells.write(directory, cell, status=abs(status) + 128 if status < 0 else status, **why)
        if status != 0:
            raise CellFailed(f"{cell.name}: {why['reason']}")

    @contextmanager
    def device(self, directory: Path) -> Iterator[dict[str, str]]:
        """The environment that shows a run the GPU that no other cell on this machine has."""
        for k in range(self.gpus):
            with cells.held(directory, f"gpu-{os.uname().nodename}-{k}") as own:
                if own is not None:
                    yield {"CUDA_VISIBLE_DEVICES": str(k)}
                    return
        yield {}


def said(lines: list[str], status: int) -> str:
    """What a run's log says of its end."""
    if status < 0:
        return f"killed by {signal.Signals(-status).name}"
    own = [line.removeprefix("sndjax: ") for line in lines if line.startswith("sndjax: ")]
    return (own or lines or [f"exit status {status}"])[-1]


def quoted(path: Path) -> str:
    """A path as a value of an override."""
    return "'" + str(path).replace("'", "\\'") + "'"


def threads(count: int) -> dict[str, str]:
    """The environment of a process that computes with so many threads."""
    names = ("PJRT_NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    return dict.fromkeys(names, str(count))


def shares(launcher: DictConfig, gpus: int) -> tuple[list[str], int]:
    """What is still to be said to a launcher, and the threads of each of its cells."""
    cores = len(os.sched_getaffinity(0))
    if "n_jobs" in launcher:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        fitting = gpus or max(1, min(cores, memory // MEMORY))
        jobs = launcher.n_jobs if launcher.n_jobs > 0 else fitting
        return [f"hydra.launcher.n_jobs={jobs}"], max(1, cores // jobs)
    if "ray" in launcher:
        return [], int(launcher.ray.remote.get("num_cpus") or 1)
    return [], int(launcher.get("cpus_per_task") or cores)


def gpus_here() -> int:
    """How many NVIDIA GPUs this machine has."""
    shown = os.environ.get("CUDA_VISIBLE_DEVICES")
    if shown is not None:
        return len([name for name in shown.split(",") if name.strip()])
    return len(list(Path("/proc/driver/nvidia/gpus").glob("*")))


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
        hint = f" (pip install '.[{PLUGINS[missing[0]]}]')" if missing else ""
        raise ConfigError(f"{reason(error)}{hint}") from None


def default_directory(own: list[str], hydras: list[str]) -> Path:
    """Where a sweep goes that names no place: the same command, the same place."""
    named = [a.removeprefix("sweep=") for a in hydras if a.startswith("sweep=")]
    if named and not own:
        return Path("runs/sweeps") / named[0]
    digest = zlib.crc32("\n".join([*named, *own]).encode())
    return Path("runs/sweeps") / f"{'-'.join([*named, f'{digest:08x}'])}"


def multirun(arguments: Sequence[str]) -> int:
    """Run a sweep, or what is left of it; the exit status.

    0 all cells are done; 1 some failed; 130 and 143 interrupted.

    Raises:
      ConfigError: nothing of it can run.
    """
    own, hydras = divided(arguments)
    hydra = asked_of_hydra(hydras)
    directory = Path(hydra.sweep.dir or default_directory(own, hydras)).resolve()
    params = [f"{key}={value}" for key, value in (hydra.sweeper.get("params") or {}).items()]
    search = not hydra.sweeper._target_.endswith(".BasicSweeper")
    (directory / STOP).unlink(missing_ok=True)
    given = [*hydras, f"hydra.sweep.dir={quoted(directory)}"]
    if search:
        asked, swept = own, cells.swept([*params, *own])
    else:
        left = to_run(directory, cells.expanded([*params, *own]))
        if not left:
            print(table(cells.survey(directory)))
            write_page(directory)
            return 0 if all_done(directory) else 1
        given.append("hydra.sweeper.params=null")
        swept = ()
        asked = ["+cell=" + ",".join(f"'{cell.name}'" for cell in left)]
    gpus = gpus_here()
    more, count = shares(hydra.launcher, gpus)
    work = Work(
        str(directory), os.getcwd(), swept, count, gpus if "n_jobs" in hydra.launcher else 0
    )
    with Overview(directory) as overview, Stopper(directory) as stopper:
        trouble = launched(work, ["-m", *given, *more, *asked])
    told = any(s.state == cells.FAILED for s in overview.standings)
    if trouble and not told and not stopper.status:
        raise ConfigError(f"the launcher gave up: {trouble}")
    print(table(overview.standings))
    if search and (found := directory / "optimization_results.yaml").is_file():
        print(f"the best by {FIGURE}, {found}:\n{found.read_text().strip()}")
    if stopper.status:
        print(f"interrupted; the same command goes on: hydra.sweep.dir={directory}")
        return stopper.status
    if any(s.step for s in overview.standings):
        write_page(directory)
    return 0 if all_done(directory) else 1


def write_page(directory: Path) -> None:
    """The page of what the cells have so far."""
    from experiments import report

    out = directory / "report"
    out.mkdir(exist_ok=True)
    with suppress(ConfigError):  # nothing to show yet
        report.write([directory], out, live=False)


def to_run(directory: Path, listed: list[cells.Cell]) -> list[cells.Cell]:
    """Keep the cells of a sweep, say what each stands at, and return those that are to run.

    Raises:
      ConfigError: none of them can.
    """
    if all(cell.problem for cell in listed):
        raise ConfigError(listed[0].problem)
    there = cells.known(directory) if (directory / cells.FILES).is_dir() else []
    before = {cell.name: last for cell, last in there}
    now = {c.name: cells.standing(directory, c, before.get(c.name, {})) for c in listed}
    for cell in listed:
        if now[cell.name].state != cells.RUNNING:
            cells.write(directory, cell, **before.get(cell.name, {}))
    words = {
        cells.DONE: "done already",
        cells.RUNNING: "running elsewhere",
        cells.STOPPED: "to go on",
        cells.FAILED: "failed before, to try again",
        cells.WAITING: "new",
    }
    counts = {state: [s for s in now.values() if s.state == state] for state in cells.STATES}
    bad = [s for s in counts[cells.FAILED] if s.cell.problem]
    counts[cells.FAILED] = [s for s in counts[cells.FAILED] if not s.cell.problem]
    parts = [f"{len(found)} {words[state]}" for state, found in counts.items() if found]
    print(f"{directory}: {len(listed)} cells: {', '.join(parts)}")
    for one in bad:
        print(f"cannot run: {one.cell.name}: {one.reason}")
    for state in (cells.STOPPED, cells.FAILED):
        for one in counts[state]:
            print(f"{words[state]}: {one.cell.name}{f': {one.reason}' if one.reason else ''}")
    ready = (cells.STOPPED, cells.FAILED, cells.WAITING)
    return [s.cell for s in now.values() if s.state in ready and not s.cell.problem]


def all_done(directory: Path) -> bool:
    """Whether every cell is."""
    return all(s.state == cells.DONE for s in cells.survey(directory))


def launched(work: Work, arguments: list[str]) -> str:
    """Hand the sweep to Hydra; what it complained of, if it did."""
    before, complaint, conf = sys.argv, StringIO(), str(CONF.resolve())
    sys.argv = ["sndjax", *arguments]
    try:
        with redirect_stderr(complaint):
            hydra_main(version_base="1.3", config_path=conf, config_name="multirun")(work)()
    except SystemExit as left:
        if left.code:
            lines = [line.strip() for line in complaint.getvalue().splitlines() if line.strip()]
            return " ".join([line for line in lines if "HYDRA_FULL_ERROR" not in line][-2:])
    except KeyboardInterrupt:  # a second signal
        return "interrupted"
    finally:
        sys.argv = before
        if "joblib" in sys.modules:  # its workers would wait for more
            from joblib.externals.loky import get_reusable_executor

            get_reusable_executor().shutdown(kill_workers=True)
    return ""


class Stopper:
    """SIGINT and SIGTERM stop a sweep in order: no cell begins, runs write a checkpoint and end."""

    def __init__(self, directory: Path):
        """Nothing was asked yet."""
        self.directory, self.status = directory, 0

    def __enter__(self) -> "Stopper":
        self.before = {s: signal.signal(s, self.stop) for s in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self.before.items():
            signal.signal(number, handler)

    def stop(self, number: int, frame: Any) -> None:
        """Pass a first signal on to the runs; a second one ends the sweep at once."""
        if self.status:
            raise KeyboardInterrupt
        self.status = 128 + number
        (self.directory / STOP).touch()
        here = os.uname().nodename
        for cell, last in cells.known(self.directory):
            if last.get("host") == here and cells.is_held(self.directory, cell.name):
                with suppress(ProcessLookupError):
                    os.kill(last["pid"], signal.SIGTERM)


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
