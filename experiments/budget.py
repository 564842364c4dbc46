"""Estimate the time, memory and disk space of a sweep of the thesis' size: sndjax budget

Reads the jobs of conf/sweep/thesis.yaml (or sweep=NAME) and the measured rates in docs/results/
bench-cpu.json (and bench-gpu.json, if it exists), and computes the operations per step and the
size of the state of each algorithm. Prints how long the sweep takes on two cores and on GPUs, and
how much memory and disk space it needs.

If an algorithm was not measured, its rate on two cores is scaled from a measured rate by the
operations per step, and its rate on a GPU is the slowest measured rate. If no GPU was measured, a
GPU is assumed to be as fast as the environments on the cores beside it, at the measured rate per
core, and the output also gives the share of the GPU's peak that this needs; only then --cores and
--gpu-tflops are used.
"""

from dataclasses import dataclass
from pathlib import Path

from .config.option import option
from .config.tool_options import run_command
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The options of the command."""

    sweep: str = option("thesis", "a file of conf/sweep")
    cores: int = option(16, "processor cores beside each GPU", low=1)
    gpu_tflops: float = option(
        494.0, "dense TF32 peak of one GPU, 10^12 operations/s (H100 SXM's data sheet)", above=0
    )


def budget(paths: list[Path], options: Options) -> None:
    """Print the tables of the estimate."""
    from .benchmarks.sweep_budget import budget_tables

    print(budget_tables(options.sweep, options.cores, options.gpu_tflops))


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, budget, arguments, paths="none")


if __name__ == "__main__":
    run_script(main)
