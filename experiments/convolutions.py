"""Time a convolution's implementations side by side: sndjax convolutions

Times one gradient of the policy's network on 512 Atari stacks: with the batch in slices of several
sizes (`sndjax.convolution` uses slices of eight images on a CPU and the whole batch elsewhere), and
with XLA's own convolution. On a GPU, where many small slices compile slowly, only the whole batch
and XLA's convolution are timed, but also with four agents at once. All implementations are timed in
turn, in another order in each round, with a matrix product before each round. Use the figures to
check whether the default suits another machine.
"""

from dataclasses import dataclass
from pathlib import Path

from .config.option import option
from .config.tool_options import run_command
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The options of the command."""

    rounds: int = option(8, "how often each is timed", low=1)


def convolutions(paths: list[Path], options: Options) -> None:
    """Time every implementation, and print a line for each."""
    from .benchmarks.convolutions import print_convolutions

    print_convolutions(options.rounds)


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, convolutions, arguments, paths="none")


if __name__ == "__main__":
    run_script(main)
