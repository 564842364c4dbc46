"""The rows of the trial that are missing, each in a child process on a core of its own."""

import os
import subprocess
import time
from pathlib import Path
from typing import NamedTuple

from ..config.command_text import option_text
from ..system.display import ProgressBars
from ..system.subprocesses import start_command
from .protocol import Method, Protocol, Task
from .rows import read_count, row_path

LOGS = Path("build") / "trial"
ANY = -1  # in place of the number of a core
LOOK_SECONDS = 0.5  # between two looks at the children


class Running(NamedTuple):
    """A row in a child process."""

    name: str
    process: subprocess.Popen[bytes]
    core: int
    log: Path


def missing_rows(protocol: Protocol, out: Path) -> list[tuple[Task, Method]]:
    """Return the rows that have no results yet.

    Args:
      protocol: of the trial.
      out: the directory of its results.
    """
    return [row for row in protocol.rows() if not row_path(out, "rows", *row).exists()]


def start_row(task: Task, method: Method, out: Path, core: int) -> Running:
    """Tune and run a row in a child process.

    Args:
      task: of the row.
      method: of the row.
      out: the directory of the trial's results.
      core: that it may use; `ANY`: any.
    """
    name = f"{task.name}/{method.name}"
    log = LOGS / f"{name}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    arguments = [f"complete={name}", option_text("out", out), f"core={core}"]
    with log.open("wb") as output:
        return Running(name, start_command("trial", arguments, output=output), core, log)


def choose_cores(jobs: int) -> list[int]:
    """Return the core of each job that runs at the same time; `ANY` where there are too few.

    Args:
      jobs: their number; 0: one on each core.
    """
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    if not jobs:
        return cores or [ANY] * (os.cpu_count() or 1)
    return cores[:jobs] if len(cores) >= jobs else [ANY] * jobs


def complete_rows(rows: list[tuple[Task, Method]], out: Path, jobs: int) -> list[str]:
    """Run rows side by side, show how far they are, and return the names of those that failed.

    Args:
      rows: what is run.
      out: the directory of the trial's results.
      jobs: see `choose_cores`.
    """
    waiting, free = list(rows), choose_cores(jobs)
    running: list[Running] = []
    failed: list[str] = []
    with ProgressBars() as bars:
        try:
            while waiting or running:
                while waiting and free:
                    row_next = waiting.pop(0)
                    if not row_path(out, "rows", *row_next).exists():  # by another process
                        running.append(start_row(*row_next, out, free.pop(0)))
                for row in list(running):
                    ended = row.process.poll() is not None
                    bars.update(row.name, *read_count(row.log.read_text(errors="replace")))
                    if not ended:
                        continue
                    running.remove(row)
                    free.append(row.core)
                    if row.process.returncode:
                        failed.append(row.name)
                time.sleep(LOOK_SECONDS)
        finally:
            for row in running:
                row.process.terminate()
    return failed
