"""Print the cost of the compiled updates: sndjax compiled_cost [ALGORITHM ...]

Prints one JSON object about each algorithm's `train_step` at the thesis configuration on Atari: the
operations of its matrix products and convolutions, with every iteration of a loop counted; XLA's
count of operations and of bytes read and written, with the body of a loop counted once; and the
megabytes of temporary buffers.
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


def compiled_cost(paths: list[Path], options: Options) -> None:
    """Print the figures of the algorithms."""
    from .benchmarks.compiled_cost import print_compiled_cost

    print_compiled_cost([str(path) for path in paths] or options.algos.split(","))


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, compiled_cost, arguments, paths="optional")


if __name__ == "__main__":
    run_script(main)
