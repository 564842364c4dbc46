"""Run the trial of docs/results/trial.md: does a self-supervised encoder beat the random one?

    sndjax trial                             every row that has no results in docs/results/trial yet
    sndjax trial only=rooms/rnd,rooms/snd_vic          some of them
    sndjax trial repeat=rooms/snd_vic seeds=3          the first seeds of a row, beside its results
    sndjax trial causes=door_key             what the modules of a task's rows see of its level
    sndjax trial page=true                   the page's tables and pictures, from the results

A row is a method on a task: 32 settings are tried, then 32 seeds that were not looked at. Rows run
side by side, one on each core, and a row that was stopped continues after its search.
"""

from dataclasses import dataclass
from pathlib import Path

from .config.option import option
from .config.tool_options import run_command
from .system.process import run_script


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
    complete: str | None = option(None, "a row to run in this process, TASK/METHOD")
    core: int = option(-1, "with complete, the core of this process; -1: any", low=-1)


def trial(paths: list[Path], options: Options) -> None:
    """Run what is asked for."""
    from .trials import stages
    from .trials.page import write_page
    from .trials.protocol import read_protocol
    from .trials.repeat import repeat_row

    protocol, out = read_protocol(), Path(options.out)
    if options.complete is not None:
        stages.complete_in_process(protocol, options.complete, out, options.core)
    elif options.repeat is not None:
        repeat_row(protocol, *protocol.find_row(options.repeat), out, options.seeds)
    elif options.causes is not None:
        stages.trace(protocol, options.causes.split(","), out)
    elif options.page:
        write_page(protocol, out)
    else:
        stages.run(protocol, options.only and options.only.split(","), out, options.jobs)


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, trial, arguments, paths="none")


if __name__ == "__main__":
    run_script(main)
