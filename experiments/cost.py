"""Count what the cells' products and convolutions cost, against PPO's: sndjax cost

Counted from the program of a whole update and of acting at the thesis configuration, with nothing
computed: a figure of the equations and the networks, the same on every machine.
"""

from dataclasses import dataclass
from pathlib import Path

from .config.tool_options import run_command
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The command has no options."""


def cost(paths: list[Path], options: Options) -> None:
    """Print the table."""
    from .benchmarks.counted_flops import print_costs

    print_costs()


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, cost, arguments, paths="none")


if __name__ == "__main__":
    run_script(main)
