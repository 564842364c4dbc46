"""Learning curves of groups of runs: the mean over seeds with its 95% bootstrap interval."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..storage.read_runs import RunGroup, SeedData
from .html_page import write_csv
from .plot_style import display_title, label_steps_axis, line_style, make_panels, plt, save_figure
from .seed_statistics import bootstrap_interval, exponential_smoothing, resample_curves

Curve = tuple[np.ndarray, np.ndarray]


class Quantity(NamedTuple):
    """A quantity to plot: its axis label, and a function that returns a seed's curve.

    The curve is (steps, values), or None if the seed has no such quantity.
    """

    axis: str
    of: Callable[[SeedData], Curve | None]


def over_episodes(column: str) -> Callable[[SeedData], Curve | None]:
    """Return a function from a seed to the curve of a column of episodes.csv.

    The values are smoothed as in the thesis (`exponential_smoothing`).
    """

    def of(seed: SeedData) -> Curve | None:
        values = seed.episodes[column]
        return (seed.episodes["step"], exponential_smoothing(values)) if len(values) else None

    return of


def over_iterations(figure: str) -> Callable[[SeedData], Curve | None]:
    """Return a function from a seed to the curve of a metric of metrics.jsonl.

    The curve has only finite values, and is None if there are none.
    """

    def of(seed: SeedData) -> Curve | None:
        values = seed.metrics.get(figure)
        if values is None:
            return None
        there = np.isfinite(values)
        return (seed.metrics["step"][there], values[there]) if there.any() else None

    return of


def intrinsic_curve(seed: SeedData) -> Curve | None:
    """Return the curve of the intrinsic reward; None for the baseline, which has none."""
    curve = over_iterations("int_reward_mean")(seed)
    return curve if curve is not None and curve[1].any() else None


def rooms_curve(seed: SeedData) -> Curve | None:
    """Return the curve of the most rooms visited in one episode so far; None without rooms."""
    rooms = seed.episodes.get("rooms")
    if rooms is None or not len(rooms):
        return None
    return seed.episodes["step"], np.maximum.accumulate(rooms)


QUANTITIES = {
    "return": Quantity("external return of an episode", over_episodes("ext_return")),
    "score": Quantity("game score of an episode", over_episodes("score")),
    "intrinsic": Quantity("intrinsic reward, mean of a step", intrinsic_curve),
    "rooms": Quantity("most rooms in one episode", rooms_curve),
    "last100": Quantity(
        "external return, mean of the last 100 episodes", over_iterations("last100_ext_return")
    ),
}


def draw_curves(
    groups: list[RunGroup], quantity: str, title: str, out: Path, name: str
) -> Path | None:
    """Draw the curves of a quantity, one for each group of runs that has the quantity.

    The line is the mean over seeds and the band its 95% bootstrap interval. Thin lines are single
    seeds, if there are at most 10. The curves are also written as a CSV file.

    Args:
      groups: the groups of runs.
      quantity: a key of `QUANTITIES`.
      title: of the picture.
      out: the directory of the files.
      name: of the files, without suffix.

    Returns:
      The path of the PNG, with an SVG beside it; None if no group has this quantity.
    """
    axis, of = QUANTITIES[quantity]
    figure, ((axes,),) = make_panels(1, 1)
    rows: list[list[str]] = []
    for group in groups:
        curves = [curve for curve in map(of, group.seeds) if curve is not None]
        if not curves:
            continue
        steps, values = resample_curves(curves)
        mean, look = values.mean(0), line_style(group.algo)
        looks = [other.name for other in groups if other.algo == group.algo]
        if looks.index(group.name):  # another variant of the same algorithm
            look["linestyle"] = ("--", ":", "-.")[(looks.index(group.name) - 1) % 3]
        if len(curves) <= 10:
            for own in curves:
                axes.plot(*own, color=look["color"], alpha=0.25, linewidth=0.8)
        band = bootstrap_interval(values)
        if band is not None:
            axes.fill_between(steps, *band, color=look["color"], alpha=0.18, linewidth=0)
        shown = display_title(group.algo, group.name).replace("$", r"\$")
        rows += [
            [group.name, *map(str, row)] for row in zip(steps, mean, *(band or ()), strict=True)
        ]
        count = f"{len(curves)} seed{'s' if len(curves) > 1 else ''}"
        axes.plot(steps, mean, linewidth=2.2, label=f"{shown}, {count}", **look)
    if not axes.lines:
        plt.close(figure)
        return None
    write_csv(out / f"{name}.csv", ["runs", "step", "mean", "low", "high"], rows)
    axes.set_title(title.replace("$", r"\$"))
    axes.set_ylabel(axis)
    label_steps_axis(axes)
    axes.legend(frameon=False, fontsize=9)
    return save_figure(figure, out, name)
