"""python -m experiments.budget: what a sweep of the thesis' size costs, on paper.

Takes the cells of conf/sweep/thesis.yaml (or sweep=NAME), the measured rates of docs/results/
bench-cpu.json (and bench-gpu.json, where there is one), each algorithm's work per step and the
size of its state, and says how long the sweep takes on two cores and on GPUs, and what it holds
in memory and on the disk. On two cores what was not measured is scaled by its work from what was;
on a GPU it is as slow as the slowest that was. Where no GPU was measured, one is as fast as the
environments that the cores beside it step, at the measured rate per core, and the page says how
much of its arithmetic that takes; --cores and --gpu-tflops are for that alone.
"""

import heapq
import json
import sys
from collections import Counter
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from experiments.arguments import command
from experiments.options import option
from experiments.process import before_jax
from experiments.progress import Bars

REFERENCE = "snd_vic"  # of algorithms that have no benchmark
LOG_BYTES = 1100  # of a line of metrics.jsonl, with TensorBoard's copy of its figures twice that
ROLLOUT_MB = {"Atari": 129 * 128 * 96 * 96 / 1e6, "Procgen": 129 * 128 * 64 * 64 * 3 / 1e6}
KEPT = 3  # checkpoints: the newest two and the best
HOUR = 3600.0


@dataclass(frozen=True)
class Options:
    """What may be said."""

    sweep: str = option("thesis", "a file of conf/sweep")
    cores: int = option(16, "processor cores beside each GPU", low=1)
    gpu_tflops: float = option(
        494.0, "dense TF32 peak of one GPU, 10^12 operations/s (H100 SXM's data sheet)", above=0
    )


class Kind(NamedTuple):
    """What the runs of one algorithm on one kind of input cost."""

    runs: int
    steps: int  # of each
    gflop: float  # per step
    state_mb: float
    iterations: int


def kinds_of(sweep: str) -> dict[tuple[str, str], Kind]:
    """By algorithm and family."""
    from experiments import cells
    from experiments.config import load
    from experiments.sweep import asked_of_hydra

    params = asked_of_hydra([f"sweep={sweep}"]).sweeper.params
    listed = cells.product([f"{key}={value}" for key, value in params.items()])
    runs = Counter(tuple(one for one in own if not one.startswith("seed=")) for own in listed)
    found: dict[tuple[str, str], Kind] = {}
    with Bars() as bars:
        for overrides in bars.over("algorithms and environments", list(runs)):
            config = load(list(overrides))
            family = "Atari" if config.env.stack == 4 else "Procgen"
            key = (config.algo.name, family)
            if key not in found:
                work, megabytes = weight(*key)
                found[key] = Kind(0, config.total_steps, work, megabytes, config.iterations)
            found[key] = found[key]._replace(runs=found[key].runs + runs[overrides])
    return found


@cache
def weight(algo: str, family: str) -> tuple[float, float]:
    """10^9 operations per step, and the megabytes of a seed's state."""
    import jax

    from experiments.cost import INPUTS, giga_per_step, thesis
    from sndjax.algorithms import NAMED

    size, _, _, actions = INPUTS[family]
    make: Any = NAMED[algo]
    module = make(actions, size) if make else None
    state = thesis(module, family)[1]._replace(key=jax.numpy.zeros(()))
    megabytes = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state)) / 1e6
    return giga_per_step(module, family), megabytes


def makespan(hours: list[float], machines: int) -> float:
    """The hours until the last of some runs is over, the longest begun first.

    >>> makespan([3.0, 2.0, 2.0, 1.0], 2)
    4.0
    """
    free = [0.0] * machines
    for own in sorted(hours, reverse=True):
        heapq.heapreplace(free, free[0] + own)
    return max(free)


def report(options: Options) -> str:
    """The tables, in Markdown."""
    from experiments.benches import figures

    measured = json.loads(figures("cpu").read_text())
    path: Path = figures("gpu")
    raw = json.loads(path.read_text()) if path.exists() else {}
    # Whole iterations where they were timed; not of several seeds at once.
    gpu: dict[str, float] = {
        name: one.get("whole_steps_per_second", one["steps_per_second"])
        for name, one in raw.items()
        if one["num_seeds"] == 1
    }
    stepping = [one["seconds_per_1000_steps"]["environment"] for one in measured.values()]
    pool = 1000 / median(stepping) / 2 * options.cores  # steps/s beside a GPU
    slowest = min(gpu.values(), default=pool)
    lines = [
        "| algorithm | input | runs | steps, millions | GFLOP a step | state, MB | GPU memory, MB "
        "| disk, MB | hours on two cores | GPU hours |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    slow: list[float] = []
    fast: list[float] = []
    disk, needed = 0.0, 0.0
    for (algo, family), kind in sorted(kinds_of(options.sweep).items()):
        known = algo if algo in measured else REFERENCE
        here = measured[known]["steps_per_second"] * weight(known, "Atari")[0] / kind.gflop
        rate = gpu.get(algo, slowest)
        needed = max(needed, rate * kind.gflop / 1e3)
        two_cores = kind.steps / here / HOUR
        on_gpu = kind.steps / rate / HOUR
        own = KEPT * kind.state_mb + 3 * LOG_BYTES * kind.iterations / 1e6
        disk += kind.runs * own
        slow += [two_cores] * kind.runs
        fast += [on_gpu] * kind.runs
        lines.append(
            f"| `{algo}` | {family} | {kind.runs} | {kind.steps / 1e6:,.0f} | {kind.gflop:.2f} "
            f"| {kind.state_mb:,.0f} | {2 * kind.state_mb + ROLLOUT_MB[family]:,.0f} | {own:,.0f} "
            f"| {two_cores:,.0f} | {on_gpu:.1f} |"
        )
    resident = max(one["peak_rss_mb"] for one in measured.values()) / 1e3
    how = (
        f"as measured (bench-gpu.json: {', '.join(gpu)}; others at {slowest:,.0f} steps/s)"
        if gpu
        else f"of {pool:,.0f} steps/s, as its environments"
    )
    lines += [
        "",
        f"{len(fast)} runs, {sum(slow):,.0f} hours on machines of two cores, "
        f"{sum(fast):,.0f} hours on GPUs {how}; {disk / 1e3:,.0f} GB on the disk; "
        f"{resident:.1f} GB of memory for each run at once.",
        "",
    ]
    if not gpu:
        lines += [
            f"A GPU keeps up with {options.cores} cores of environments as long as its learner "
            f"reaches {needed:,.0f} TFLOP/s ({needed / options.gpu_tflops:.0%} of its TF32 peak) "
            "for the heaviest algorithm; below that it is the limit.",
            "",
        ]
    lines += [
        "| GPUs | days | busy | memory, GB | the longest run, hours |",
        "|---|---|---|---|---|",
    ]
    for count in (1, 8, 64):
        hours = makespan(fast, count)
        lines.append(
            f"| {count} | {hours / 24:,.1f} | {sum(fast) / (count * hours):.0%} "
            f"| {count * resident:,.0f} | {max(fast):.1f} |"
        )
    return "\n".join(lines)


def main(arguments: list[str]) -> int:
    """Print the tables."""
    return command(
        __doc__ or "", Options, lambda _, own: print(report(own)), arguments, needs_places=False
    )


if __name__ == "__main__":
    before_jax()
    sys.exit(main(sys.argv[1:]))
