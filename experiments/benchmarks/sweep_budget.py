"""The estimated cost of a sweep of the thesis' size."""

import heapq
import json
from collections import Counter
from functools import cache
from statistics import median
from typing import Any, NamedTuple, cast

import jax

from sndjax.algorithms import NAMED

from ..config.compose import load_config
from ..sweeps import jobs
from ..sweeps.multirun import compose_hydra
from ..system.display import ProgressBars
from .counted_flops import INPUTS, gflop_per_step, thesis_experiment
from .gpu_page import read_rows
from .suite import RESULTS, results_file

REFERENCE = "snd_vic"  # whose benchmark is used for algorithms without one
LOG_BYTES = 1100  # of a line of metrics.jsonl; TensorBoard's copy of its figures takes twice that
ROLLOUT_MB = {"Atari": 129 * 128 * 96 * 96 / 1e6, "Procgen": 129 * 128 * 64 * 64 * 3 / 1e6}
KEPT = 3  # checkpoints: the newest two and the best
HOUR = 3600.0


class RunCost(NamedTuple):
    """The cost of the runs of one algorithm on one kind of input."""

    runs: int
    steps: int  # of each run
    gflop: float  # per step
    state_mb: float
    iterations: int


def sweep_costs(sweep: str) -> dict[tuple[str, str], RunCost]:
    """Return the cost of the runs of a sweep, by algorithm and family of environments."""
    params = compose_hydra([f"sweep={sweep}"]).sweeper.params
    listed = jobs.expand_product([f"{key}={value}" for key, value in params.items()])
    runs = Counter(tuple(one for one in own if not one.startswith("seed=")) for own in listed)
    found: dict[tuple[str, str], RunCost] = {}
    with ProgressBars() as bars:
        for overrides in bars.track("algorithms and environments", list(runs)):
            config = load_config(list(overrides))
            family = "Atari" if config.env.stack == 4 else "Procgen"
            key = (config.algo.name, family)
            if key not in found:
                work, megabytes = work_and_state(*key)
                found[key] = RunCost(0, config.total_steps, work, megabytes, config.iterations)
            found[key] = found[key]._replace(runs=found[key].runs + runs[overrides])
    return found


@cache
def work_and_state(algo: str, family: str) -> tuple[float, float]:
    """Return the operations per step in 10^9, and the size of a seed's state in MB."""
    size, _, _, actions = INPUTS[family]
    make: Any = NAMED[algo]
    module = make(actions, size) if make else None
    state = cast(Any, thesis_experiment(module, family)[1])._replace(key=jax.numpy.zeros(()))
    megabytes = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state)) / 1e6
    return gflop_per_step(module, family), megabytes


def makespan(hours: list[float], machines: int) -> float:
    """Return the hours until the last run ends if the longest runs start first.

    >>> makespan([3.0, 2.0, 2.0, 1.0], 2)
    4.0
    """
    free = [0.0] * machines
    for own in sorted(hours, reverse=True):
        heapq.heapreplace(free, free[0] + own)
    return max(free)


class Rates(NamedTuple):
    """The measured rates.

    Attributes:
      cpu: the figures of the benchmarks on two cores, by algorithm.
      gpu: steps per second on a GPU, by algorithm; empty where none was measured.
      pool: steps per second of the environments on the cores beside a GPU.
    """

    cpu: dict[str, Any]
    gpu: dict[str, float]
    pool: float

    @property
    def slowest_gpu(self) -> float:
        """Return the rate of algorithms that were not measured on a GPU."""
        return min(self.gpu.values(), default=self.pool)


def read_rates(cores: int) -> Rates:
    """Return the committed rates, with `cores` processor cores beside each GPU."""
    cpu = json.loads(results_file("cpu").read_text())
    path = results_file("gpu")
    raw = json.loads(path.read_text()) if path.exists() else {}
    # Whole iterations if they were timed; benchmarks of several seeds are left out.
    gpu = {
        name: one.get("whole_steps_per_second", one["steps_per_second"])
        for name, one in raw.items()
        if one["num_seeds"] == 1
    }
    # Of `gpu_suite`, which times the same iterations as a run takes them now.
    for row in read_rows(RESULTS / "gpu" / "module_beside.jsonl")[-1:]:
        if not row["small"]:
            gpu["snd_std"] = row["steps_per_second"]
    stepping = [one["seconds_per_1000_steps"]["environment"] for one in cpu.values()]
    return Rates(cpu, gpu, 1000 / median(stepping) / 2 * cores)


class SweepTotals(NamedTuple):
    """The needs of all runs of a sweep.

    Attributes:
      slow: the hours of every run on two cores.
      fast: the hours of every run on a GPU.
      disk: the disk space of all runs, in MB.
      tflops: the 10^12 operations per second that the heaviest algorithm needs from a GPU.
    """

    slow: list[float]
    fast: list[float]
    disk: float
    tflops: float


def algorithm_rows(sweep: str, rates: Rates) -> tuple[list[str], SweepTotals]:
    """Return the lines of the table of algorithms, and the needs of all runs together."""
    lines = [
        "| algorithm | input | runs | steps, millions | GFLOP a step | state, MB | GPU memory, MB "
        "| disk, MB | hours on two cores | GPU hours |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    slow: list[float] = []
    fast: list[float] = []
    disk, tflops = 0.0, 0.0
    for (algo, family), cost in sorted(sweep_costs(sweep).items()):
        known = algo if algo in rates.cpu else REFERENCE
        work = work_and_state(known, "Atari")[0]
        here = rates.cpu[known]["steps_per_second"] * work / cost.gflop
        rate = rates.gpu.get(algo, rates.slowest_gpu)
        tflops = max(tflops, rate * cost.gflop / 1e3)
        two_cores = cost.steps / here / HOUR
        on_gpu = cost.steps / rate / HOUR
        own = KEPT * cost.state_mb + 3 * LOG_BYTES * cost.iterations / 1e6
        disk += cost.runs * own
        slow += [two_cores] * cost.runs
        fast += [on_gpu] * cost.runs
        lines.append(
            f"| `{algo}` | {family} | {cost.runs} | {cost.steps / 1e6:,.0f} | {cost.gflop:.2f} "
            f"| {cost.state_mb:,.0f} | {2 * cost.state_mb + ROLLOUT_MB[family]:,.0f} | {own:,.0f} "
            f"| {two_cores:,.0f} | {on_gpu:.1f} |"
        )
    return lines, SweepTotals(slow, fast, disk, tflops)


def budget_tables(sweep: str, cores: int, gpu_tflops: float) -> str:
    """Return the tables of the estimate, in Markdown.

    Args:
      sweep: the name of a file in conf/sweep.
      cores: the number of processor cores beside each GPU.
      gpu_tflops: the peak rate of one GPU, in 10^12 operations per second.
    """
    rates = read_rates(cores)
    lines, totals = algorithm_rows(sweep, rates)
    slow, fast = totals.slow, totals.fast
    resident = max(one["peak_rss_mb"] for one in rates.cpu.values()) / 1e3
    how = f"of {rates.pool:,.0f} steps/s, as its environments"
    if rates.gpu:
        others = f"others at {rates.slowest_gpu:,.0f} steps/s"
        how = f"as measured (bench-gpu.json: {', '.join(rates.gpu)}; {others})"
    lines += [
        "",
        f"{len(fast)} runs, {sum(slow):,.0f} hours on machines of two cores, "
        f"{sum(fast):,.0f} hours on GPUs {how}; {totals.disk / 1e3:,.0f} GB on the disk; "
        f"{resident:.1f} GB of memory for each run at once.",
        "",
    ]
    if not rates.gpu:
        lines += [
            f"A GPU keeps up with {cores} cores of environments as long as its learner reaches "
            f"{totals.tflops:,.0f} TFLOP/s ({totals.tflops / gpu_tflops:.0%} of its TF32 peak) "
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
