"""Estimate what a sweep of the thesis' size costs: sndjax budget

Takes the jobs of conf/sweep/thesis.yaml (or sweep=NAME), the measured rates of docs/results/
bench-cpu.json (and bench-gpu.json, where there is one), each algorithm's work per step and the
size of its state, and says how long the sweep takes on two cores and on GPUs, and what it holds
in memory and on the disk. On two cores what was not measured is scaled by its work from what was;
on a GPU it is as slow as the slowest that was. Where no GPU was measured, one is as fast as the
environments that the cores beside it step, at the measured rate per core, and the page says how
much of its arithmetic that takes; --cores and --gpu-tflops are only for that.
"""

from dataclasses import dataclass
from pathlib import Path

from .config.schema import option
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
    """Print the tables."""
    from .benchmarks.sweep_budget import budget_tables

    print(budget_tables(options.sweep, options.cores, options.gpu_tflops))


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, budget, arguments, paths="none")


if __name__ == "__main__":
    run_script(main)
