"""Time a convolution's implementations side by side: sndjax convolutions

One gradient of the policy's network on 512 Atari stacks: in slices of several sizes (on a CPU
`sndjax.convolution` takes eight images, elsewhere the whole batch) and with XLA's own
convolution. On a GPU, where many small slices compile slowly, only the whole batch and XLA's own,
but of four agents at once too. All in turn, each round in another order, a matrix product before
each round. For whoever wants to know whether what was chosen suits another machine.
"""

from dataclasses import dataclass
from pathlib import Path

from .config.schema import option
from .config.tool_options import run_command
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The options of the command."""

    rounds: int = option(8, "how often each is timed", low=1)


def convolutions(paths: list[Path], options: Options) -> None:
    """Print a line for each implementation."""
    from .benchmarks.convolutions import print_convolutions

    print_convolutions(options.rounds)


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, convolutions, arguments, paths="none")


if __name__ == "__main__":
    run_script(main)
