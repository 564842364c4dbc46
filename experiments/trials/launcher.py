"""The rows of the trial that are missing, each in a child process on a core of its own."""

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from ..config.command_text import option_text
from ..system.process import available_cores
from ..system.subprocesses import start_command
from .protocol import Method, Protocol, Task
from .rows import row_path

LOGS = Path("build") / "trial"
ANY = -1  # in place of the number of a core


def missing_rows(protocol: Protocol, out: Path) -> list[tuple[Task, Method]]:
    """Return the rows that have no results yet.

    Args:
      protocol: of the trial.
      out: the directory of its results.
    """
    return [row for row in protocol.rows() if not row_path(out, "rows", *row).exists()]


def run_child(task: Task, method: Method, out: Path, core: int) -> int:
    """Tune and run a row in a child process, and return its exit status.

    Args:
      task: of the row.
      method: of the row.
      out: the directory of the trial's results.
      core: that it may use; `ANY`: any.
    """
    log = LOGS / task.name / f"{method.name}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    row = f"complete={task.name}/{method.name}"
    arguments = [row, option_text("out", out), f"core={core}"]
    with log.open("ab") as output:
        return start_command("trial", arguments, output=output).wait()


def complete_rows(rows: list[tuple[Task, Method]], out: Path, jobs: int) -> list[str]:
    """Run rows side by side, print each that ends, and return the names of those that failed.

    Args:
      rows: what is run.
      out: the directory of the trial's results.
      jobs: how many at the same time.
    """
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    free = cores[:jobs] if len(cores) >= jobs else [ANY] * jobs
    failed = []

    def run(row: tuple[Task, Method]) -> None:
        core = free.pop()
        name = f"{row[0].name}/{row[1].name}"
        status = run_child(*row, out, core)
        free.append(core)
        print(f"{name}: {'done' if status == 0 else f'failed, see {LOGS}/{name}.log'}", flush=True)
        if status:
            failed.append(name)

    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(run, rows))
    return failed


def default_jobs() -> int:
    """Return how many rows are run at the same time, if it is not said: one on each core."""
    return available_cores()
