"""Run the trial of docs/results/trial.md: does a self-supervised encoder beat the random one?

    sndjax trial                             every row that has no results in docs/results/trial yet
    sndjax trial only=rooms/rnd,rooms/snd_vic          some of them
    sndjax trial repeat=rooms/snd_vic seeds=3          the first seeds of a row, beside its results
    sndjax trial causes=door_key             what the modules of a task's rows see of its level
    sndjax trial page=true                   the page's tables and pictures, from the results

A row is a method on a task: 32 settings are tried, then 30 seeds that were not looked at. Rows run
side by side, one on each core, and a row that was stopped goes on after its search.
"""

import os
from dataclasses import dataclass
from pathlib import Path

from .config.option import option
from .config.tool_options import run_command
from .system.errors import ConfigError
from .system.process import run_script

MOST_NAMES = 5  # of rows that failed, in a message


@dataclass(frozen=True)
class Options:
    """The options of the command."""

    only: str | None = option(None, "the rows to run, TASK/METHOD by commas; default: all")
    repeat: str | None = option(None, "a row whose seeds are run again, TASK/METHOD")
    seeds: int = option(1, "with repeat, the number of seeds", low=1, high=1000)
    causes: str | None = option(None, "tasks whose levels are walked through, by commas")
    page: bool = option(False, "only write the tables and pictures of the results")
    out: str = option("docs/results/trial", "where the results are")
    jobs: int = option(0, "rows at the same time; 0: one on each core", low=0)
    complete: str | None = option(None, "one row in this process, for the command itself")
    core: int = option(-1, "the core of that process; -1: any", low=-1)


def trial(paths: list[Path], options: Options) -> None:
    """Run what was asked for.

    Raises:
      ConfigError: a row is not known, or some rows failed.
    """
    if options.core >= 0 and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {options.core})
    from .trials.launcher import LOGS, complete_rows, missing_rows
    from .trials.protocol import read_protocol

    protocol, out = read_protocol(), Path(options.out)
    if options.complete is not None:
        from .trials.rows import complete_row

        complete_row(protocol, *protocol.find_row(options.complete), out)
        return
    if options.repeat is not None:
        from .trials.repeat import repeat_row

        repeat_row(protocol, *protocol.find_row(options.repeat), out, options.seeds)
        return
    if options.causes is not None:
        from .trials.causes import complete_causes

        for name in options.causes.split(","):
            complete_causes(protocol, protocol.find_task(name.strip()), out)
        return
    if not options.page:
        rows = missing_rows(protocol, out)
        if options.only is not None:
            wanted = [protocol.find_row(name.strip()) for name in options.only.split(",")]
            rows = [row for row in wanted if row in rows]
        print(f"{len(rows)} rows to run", flush=True)
        failed = complete_rows(rows, out, options.jobs)
        if failed:
            names = ", ".join(failed[:MOST_NAMES]) + ", ..." * (len(failed) > MOST_NAMES)
            raise ConfigError(f"{len(failed)} rows failed: {names}; what they printed: {LOGS}")
    from .trials.page import write_page

    write_page(protocol, out)


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, trial, arguments, paths="none")


if __name__ == "__main__":
    run_script(main)
