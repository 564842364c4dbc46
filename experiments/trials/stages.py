"""What the command `sndjax trial` can be asked for."""

import os
from collections.abc import Sequence
from pathlib import Path

from ..system.errors import ConfigError
from .causes import complete_causes
from .chance import measure_chance
from .launcher import LOGS, complete_rows, missing_rows
from .page import write_page
from .protocol import Protocol
from .rows import complete_row

MOST_NAMES = 5  # of rows that failed, in a message


def complete_in_process(protocol: Protocol, name: str, out: Path, core: int) -> None:
    """Tune and run a row in this process.

    Args:
      protocol: of the trial.
      name: of the row, TASK/METHOD.
      out: the directory of its results.
      core: that this process may use; negative: any.
    """
    if core >= 0 and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})
    complete_row(protocol, *protocol.find_row(name), out)


def trace(protocol: Protocol, names: Sequence[str], out: Path) -> None:
    """Trace the causes of the rows of some tasks.

    Args:
      protocol: of the trial.
      names: of the tasks.
      out: the directory of its results.

    Raises:
      ConfigError: a task is not known, or none of its rows has results.
    """
    for task in [protocol.find_task(name.strip()) for name in names]:
        if not complete_causes(protocol, task, out):
            raise ConfigError(f"causes={task.name}: no row of it has results in {out} yet")


def run(protocol: Protocol, only: Sequence[str] | None, out: Path, jobs: int) -> None:
    """Run the rows that have no results yet, and write the page.

    Args:
      protocol: of the trial.
      only: the names of rows; None: all.
      out: the directory of its results.
      jobs: how many at the same time; 0: one on each core.

    Raises:
      ConfigError: a row is not known, or some rows failed.
    """
    rows = missing_rows(protocol, out)
    if only is not None:
        wanted = [protocol.find_row(name.strip()) for name in only]
        rows = [row for row in wanted if row in rows]
    print(f"{len(rows)} rows to run", flush=True)
    failed = complete_rows(rows, out, jobs)
    measure_chance(protocol, out)
    write_page(protocol, out)
    if failed:
        names = ", ".join(failed[:MOST_NAMES]) + ", ..." * (len(failed) > MOST_NAMES)
        raise ConfigError(f"{len(failed)} rows failed: {names}; what they printed: {LOGS}")
