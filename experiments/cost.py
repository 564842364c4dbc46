"""Count the operations of the algorithms and cells, relative to PPO: sndjax cost

Counts the matrix products and convolutions in the program of a whole update and of acting, at the
thesis configuration. Nothing is computed: the figures depend only on the equations and the
networks, and are the same on every machine. A cell is an objective with a signal.
"""

from dataclasses import dataclass
from pathlib import Path

from .config.tool_options import run_command
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The command has no options."""


def cost(paths: list[Path], options: Options) -> None:
    """Print the table of operations."""
    from .benchmarks.counted_flops import print_costs

    print_costs()


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, cost, arguments, paths="none")


if __name__ == "__main__":
    run_script(main)
