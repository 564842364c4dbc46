"""Time each phase of a training iteration: sndjax bench env=Venture algo=snd_std

Times each phase on some of its minibatches and scales the time up to a whole iteration, so that the
table is ready within minutes; with --whole a real iteration is timed too. The last line is one JSON
object with the same figures.
"""

from dataclasses import dataclass

from .config.option import option
from .config.schema import Config
from .config.tool_options import run_config_command
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The options of the command."""

    whole: bool = option(False, "time a whole iteration too")


def bench(config: Config, options: Options) -> None:
    """Time the phases, and print the table and the JSON object."""
    from .benchmarks.phases import print_benchmark

    print_benchmark(config, options.whole)


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_config_command(__doc__, Options, bench, arguments)


if __name__ == "__main__":
    run_script(main)
