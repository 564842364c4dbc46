"""Print the table of a sweep: sndjax seed_table DIR --out docs/results/explores/NAME

Reads every run in the directories, also behind symbolic links, or a NAME.json of an earlier call,
and prints a Markdown table:
the external return of the last 100 episodes of each seed, the mean over seeds with its 95%
bootstrap interval, the number of seeds that reach the goal, the mean over all episodes, and the
seconds of training. Writes NAME.json with the runs' summaries, and NAME.png with a dot for every
seed.
"""

import sys
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path

from .config.option import option
from .config.tool_options import run_command
from .system.errors import ConfigError
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The options of the command."""

    out: str | None = option(None, "where NAME.json and NAME.png go, without their endings")
    goal: float = option(0.9, "a seed reaches the goal with this return of its last 100 episodes")


def print_table(paths: list[Path], options: Options) -> None:
    """Print the table, and write the files if the option `out` is given.

    Raises:
      ConfigError: there is no finished run.
    """
    from .reporting.seed_table import draw_seeds, load_summaries, markdown_table, write_summaries
    from .system.display import ProgressBars

    with redirect_stdout(sys.stderr), ProgressBars() as bars:  # stdout is for the table
        summaries, unfinished, left_out = load_summaries(paths, bars)
    for run in unfinished:
        print(f"not finished: {run}", file=sys.stderr)
    for place, reason in left_out:
        print(f"left out: {place}: {reason}", file=sys.stderr)
    if not summaries:
        raise ConfigError(f"no finished run in {', '.join(map(str, paths))}")
    print("\n".join(markdown_table(summaries, options.goal)))
    if options.out is not None:
        path = Path(options.out)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_summaries(summaries, path.with_name(f"{path.name}.json"))
        draw_seeds(summaries, options.goal, path)


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, print_table, arguments)


if __name__ == "__main__":
    run_script(main)
