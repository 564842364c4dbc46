"""One cell of a sweep, as a launcher runs it: a process of its own, its lock, and how it ended."""

import itertools
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException
from omegaconf import DictConfig

from experiments import cells

FIGURE = "mean_ext_return"  # what a search maximises: it counts how early as well as how often
STOP = "stop"  # a file: no cell begins, and those that run are told to end
FAILED = "cell"  # how the word of a cell's failure begins
PATIENCE = 60.0  # seconds that a run may take to end after its worker was killed


class CellFailed(CompactHydraException):
    """A cell's run did not finish; raised where it ran, so that its launcher knows."""


@dataclass(frozen=True)
class Work:
    """What a launcher runs: one cell, in a process of its own. Importable, so it can travel."""

    directory: str
    start: str  # the directory that the sweep was started in
    starter: int  # the process that did
    swept: tuple[str, ...]  # the keys that a search gives values to
    threads: int
    gpus: tuple[str, ...]  # that cells share out among them

    def __call__(self, config: DictConfig) -> float | None:
        """Run the cell that Hydra's job names; the figure that a search goes by.

        Raises:
          CellFailed: why it did not finish.
        """
        directory = Path(self.directory)
        cell = self.cell(directory, config)
        with cells.held(directory, cell.name, PATIENCE) as log:
            if log is None:
                raise CellFailed(f"{FAILED} {cell.name}: another process runs it")
            if (directory / STOP).exists():
                raise CellFailed(f"{FAILED} {cell.name}: not begun, the sweep was interrupted")
            if cell.problem is None:
                self.run(directory, cell, log)
            steps, value = cells.figure(directory / cell.name, FIGURE)
        if cell.problem is not None or steps < cell.total:
            raise CellFailed(f"{FAILED} {cell.name}: {cell.problem or 'not finished'}")
        if self.swept and value is None:
            raise CellFailed(f"{FAILED} {cell.name}: no episode ended, there is nothing to go by")
        return value

    def cell(self, directory: Path, config: DictConfig) -> cells.Cell:
        """The cell of Hydra's job: one that was listed, or what a search came upon."""
        if name := config.get("cell"):
            return cells.recorded(cells.file_of(directory, name, "json"))[0]
        overrides, _ = cells.divided(HydraConfig.get().overrides.task)
        GlobalHydra.instance().clear()  # the job's own is not asked again; `load` makes another
        cell = cells.checked(cells.name_of(overrides, self.swept), overrides)
        path = cells.file_of(directory, cell.name, "json")
        known = cells.recorded(path)[0] if path.exists() else None
        if other := cells.conflict(directory, cell, known):
            return cell._replace(problem=other)
        if cells.figure(directory / cell.name, FIGURE)[0] < cell.total or cell.problem:
            cells.write(directory, cell)
        return cell

    def run(self, directory: Path, cell: cells.Cell, log: int) -> None:
        """Begin the cell's run or go on with it, and keep how it ended."""
        place = directory / cell.name
        if cells.figure(place, FIGURE)[0] >= cell.total:
            return
        command = [sys.executable, "-m", "experiments.run", *cell.overrides]
        command += [f"run_dir={cells.quoted(place)}", "resume=auto"]
        if "group" not in cells.parsed(cell.overrides):
            command.append(f"group={cells.quoted(directory)}")
        if shutil.which("setpriv"):  # so that a run does not outlive the worker that waits for it
            command = ["setpriv", "--pdeathsig", "TERM", *command]
        before = os.fstat(log).st_size
        with self.device() as device:
            with deaf(os.getpid() != self.starter):
                process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    cwd=self.start,
                    env=os.environ | threads(self.threads) | device,
                    start_new_session=True,  # Ctrl-C is for the sweep, which passes it on
                )
            cells.write(directory, cell, pid=process.pid)
            try:
                status = waited(process, directory / STOP)
            except BaseException:  # whatever a launcher raises in its workers at a time limit
                process.terminate()
                status = process.wait()
                raise
            finally:
                text = cells.file_of(directory, cell.name, "log").read_bytes()[before:]
                why = {"reason": said(text.decode(errors="replace").splitlines(), status)}
                code = 128 - status if status < 0 else status
                cells.write(directory, cell, status=code, **(why if status else {}))
        if status != 0:
            raise CellFailed(f"{FAILED} {cell.name}: {why['reason']}")

    @contextmanager
    def device(self) -> Iterator[dict[str, str]]:
        """The environment that shows a run one GPU, if there is one that no other cell here has."""
        locks = Path(tempfile.gettempdir()) / f"sndjax-gpus-{os.getuid()}"
        for name in self.gpus:
            with cells.held(locks, name) as own:
                if own is not None:
                    yield sharing() | {"CUDA_VISIBLE_DEVICES": name}
                    return
        if self.gpus:
            yield sharing() | {"CUDA_VISIBLE_DEVICES": random.choice(self.gpus)}
        else:
            yield {}


@contextmanager
def deaf(worker: bool) -> Iterator[None]:
    """What is begun inside does not hear the signal by which Slurm tells a job of its time limit.

    That is for the worker, which ends its run in order. From here on a worker does not hear a
    terminal's Ctrl-C: that is for the sweep.
    """
    if not worker or threading.current_thread() is not threading.main_thread():
        yield
        return
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    heard = signal.signal(signal.SIGUSR2, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGUSR2, heard)


def waited(process: subprocess.Popen[bytes], stop: Path) -> int:
    """The status a run ends with; when the sweep is to stop it gets a SIGTERM."""
    told = False
    while True:
        with suppress(subprocess.TimeoutExpired):
            return process.wait(1.0)
        if not told and stop.exists():
            process.terminate()
            told = True


def said(lines: list[str], status: int) -> str:
    """What a run's log says of its end."""
    if status < 0:
        return f"killed by {signal.Signals(-status).name}"
    own = [line.removeprefix("sndjax: ") for line in lines if line.startswith("sndjax: ")]
    return (own or lines or [f"exit status {status}"])[-1]


def threads(count: int) -> dict[str, str]:
    """The environment of a process that computes with so many threads."""
    names = ("PJRT_NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    return dict.fromkeys(names, str(count))


def sharing() -> dict[str, str]:
    """The environment of a process that leaves others their part of a GPU's memory.

    Unless told otherwise, jax takes three quarters of it at once.
    """
    name = "XLA_PYTHON_CLIENT_PREALLOCATE"
    return {name: os.environ.get(name, "false")}


def gpus_here() -> tuple[str, ...]:
    """The names of the NVIDIA GPUs that this process may use."""
    shown = os.environ.get("CUDA_VISIBLE_DEVICES")
    if shown is None:
        return tuple(str(k) for k, _ in enumerate(Path("/proc/driver/nvidia/gpus").glob("*")))
    names = [name.strip() for name in shown.split(",")]
    return tuple(itertools.takewhile(lambda name: name not in ("", "-1"), names))
