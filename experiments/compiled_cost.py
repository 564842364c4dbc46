"""Print what the compiled updates compute: sndjax compiled_cost [ALGORITHM ...]

One JSON object: of each algorithm's `train_step` at the thesis configuration on Atari the
operations of its products, every turn of a loop counted; XLA's own count of operations and of
bytes read and written, to which the body of a loop counts once; and the megabytes of temporaries.
"""

from dataclasses import dataclass
from pathlib import Path

from .config.schema import option
from .config.tool_options import run_command
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The options of the command."""

    algos: str = option("ppo,rnd,icm,sp,snd_vic,snd_std", "algorithms, with commas")


def compiled_cost(paths: list[Path], options: Options) -> None:
    """Print the figures."""
    from .benchmarks.compiled_cost import print_compiled_cost

    print_compiled_cost([str(path) for path in paths] or options.algos.split(","))


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, compiled_cost, arguments, paths="optional")


if __name__ == "__main__":
    run_script(main)
