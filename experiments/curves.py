"""Learning curves of runs, from their metrics.jsonl."""

import json
from collections import defaultdict
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import FuncFormatter

# One colour per algorithm everywhere; Okabe and Ito's palette survives colour blindness.
COLOURS = {"ppo": "#000000", "rnd": "#E69F00", "snd_std": "#0072B2", "snd_vic": "#009E73"}
OTHER = "#CC79A7"
LABELS = {"ppo": "PPO", "rnd": "RND", "snd_std": "SND-STD", "snd_vic": "SND-VIC"}


def read(run: Path, key: str) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Steps and values of one key of `metrics.jsonl`, by seed; lines without it are left out."""
    points: dict[int, list[tuple[float, float]]] = defaultdict(list)
    whole, _, _ = (run / "metrics.jsonl").read_text().rpartition("\n")  # it may be being written
    for line in whole.splitlines():
        entry = json.loads(line)
        points[entry["seed"]]
        if entry.get(key) is not None:
            points[entry["seed"]].append((entry["step"], entry[key]))
    return {
        seed: (np.array([p[0] for p in some]), np.array([p[1] for p in some]))
        for seed, some in points.items()
    }


def draw(runs: dict[str, Path], title: str, ylabel: str, out: Path) -> None:
    """Draw one curve per seed of each algorithm's run, and their mean.

    Args:
      runs: the run directory of each algorithm.
      title, ylabel: of the picture; the curves are means of the last 100 episodes.
      out: where the PNG goes.
    """
    figure, axes = plt.subplots(figsize=(7.2, 4.2), dpi=150, layout="constrained")
    for algo, run in runs.items():
        colour = COLOURS.get(algo, OTHER)
        curves = read(run, "last100_ext_return")
        for steps, values in curves.values():
            axes.plot(steps, values, color=colour, alpha=0.35, linewidth=1)
        shared = sorted(set.intersection(*(set(steps) for steps, _ in curves.values())))
        mean = [
            np.mean([values[np.searchsorted(steps, step)] for steps, values in curves.values()])
            for step in shared
        ]
        seeds = f"{len(curves)} seed{'s' if len(curves) > 1 else ''}"
        label = f"{LABELS.get(algo, algo)}, mean of {seeds}"
        axes.plot(shared, mean, color=colour, linewidth=2.5, label=label)
    axes.set_title(title)
    axes.set_xlabel("agent steps per seed")
    axes.set_ylabel(ylabel)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x / 1000:,.0f}k" if x else "0"))
    axes.set_xlim(left=0)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="center right")
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out)
    plt.close(figure)
