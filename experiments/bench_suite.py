"""Compare all benchmarks with the committed figures: sndjax bench_suite [--write]

Runs `sndjax bench env=Venture` for each algorithm in a separate process (on a GPU also SND-STD with
four seeds at once), and prints the figures and their ratio to the committed ones in docs/results/:
bench-cpu.json or bench-gpu.json, which --write replaces. The ratio compares shares of the machine's
matrix product rate, so that a slower machine does not look like a regression.
"""

from dataclasses import dataclass
from pathlib import Path

from .config.option import option
from .config.tool_options import run_command
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The options of the command."""

    algos: str = option("ppo,rnd,icm,sp,snd_vic,snd_std", "algorithms, with commas")
    write: bool = option(False, "replace the committed figures")


def suite(paths: list[Path], options: Options) -> None:
    """Run the benchmarks, and print a line for each."""
    from .benchmarks.suite import print_suite

    named = [str(path) for path in paths]  # bench_suite rnd icm
    print_suite(named or options.algos.split(","), options.write)


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, suite, arguments, paths="optional")


if __name__ == "__main__":
    run_script(main)
