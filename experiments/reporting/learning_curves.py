"""Learning curves of groups of runs: the mean over seeds with its 95% bootstrap interval."""

from collections.abc import Callable
from math import ceil
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
from matplotlib.lines import Line2D

from ..storage.read_runs import RunGroup, SeedData
from .curve_means import MeanCurve, count_changes, mean_curve, resample_curves
from .html_page import write_csv
from .plot_style import display_title, label_steps_axis, line_styles, make_panels, save_figure
from .seed_statistics import exponential_smoothing
from .seed_steps import differ_in_steps, format_ends

Curve = tuple[np.ndarray, np.ndarray]
MOST_THIN = 10  # single seeds of a group that are drawn
MOST_LINES = 100  # single seeds of a figure that are drawn
MOST_INSIDE = 5  # groups whose legend is inside the axes
LEGEND_ROWS = 40
WIDE = 48  # characters in a line of the legend
REPEAT: dict[str, Any] = {"marker": "o", "markersize": 4, "markerfacecolor": "none", "alpha": 0.7}
MARKS: dict[str, dict[str, Any]] = {
    "end": {"marker": "X", "markersize": 10, "linestyle": "none", "markeredgecolor": "black"},
    "begin": {"marker": "|", "markersize": 9, "linestyle": "none", "markeredgewidth": 1.5},
}
LEGEND = {
    "seed": {"linewidth": 0.8, "alpha": 0.5, "label": "one seed"},
    "repeat": {"linewidth": 0.8, "label": "a repeated run, not in the mean"} | REPEAT,
    "end": {"label": "a seed ends: the mean is over fewer"} | MARKS["end"],
    "begin": {"label": "a seed's first value: the mean is over more"} | MARKS["begin"],
}


class Quantity(NamedTuple):
    """A quantity to plot: its axis label, and a function that returns a seed's curve.

    The curve is (steps, values), or None if the seed has no such quantity.
    """

    axis: str
    of: Callable[[SeedData], Curve | None]


def over_episodes(column: str) -> Callable[[SeedData], Curve | None]:
    """Return a function from a seed to the curve of a column of episodes.csv.

    The values are smoothed as in the thesis (`exponential_smoothing`). Values that are not finite
    are left out.
    """

    def of(seed: SeedData) -> Curve | None:
        values = seed.episodes[column]
        there = np.isfinite(values)
        if not there.any():
            return None
        return seed.episodes["step"][there], exponential_smoothing(values[there])

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


def held_to_end(seed: SeedData, of: Callable[[SeedData], Curve | None]) -> Curve | None:
    """Return the curve of a seed, with its last value held until the last step of the seed.

    Args:
      seed: the seed.
      of: a function from a seed to its curve.
    """
    curve = of(seed)
    if curve is None or curve[0][-1] >= seed.metrics["step"][-1]:
        return curve
    return np.append(curve[0], seed.metrics["step"][-1]), np.append(curve[1], curve[1][-1])


class GroupCurves(NamedTuple):
    """The curves of a group of runs on common steps; the first rows are the seeds."""

    steps: np.ndarray  # [P]
    seeds: np.ndarray  # [S, P], NaN before the first and after the last step of a seed
    repeats: np.ndarray  # [R, P], of repeated runs
    mean: MeanCurve  # over the seeds


def group_curves(group: RunGroup, quantity: str) -> GroupCurves | None:
    """Return the curves of a quantity of a group of runs; None if no seed has the quantity."""
    of = QUANTITIES[quantity].of
    seeds = [curve for seed in group.seeds if (curve := held_to_end(seed, of)) is not None]
    repeats = [curve for seed in group.repeats if (curve := held_to_end(seed, of)) is not None]
    if not seeds:
        return None
    steps, values = resample_curves([*seeds, *repeats])
    own = values[: len(seeds)]
    return GroupCurves(steps, own, values[len(seeds) :], mean_curve(own))


def draw_seeds(axes: Any, curves: GroupCurves, look: dict[str, Any]) -> set[str]:
    """Draw the single seeds of a group and its repeats as thin lines.

    Args:
      axes: matplotlib's axes.
      curves: the curves.
      look: the line style of the group.

    Returns:
      The keys of `LEGEND` that were drawn.
    """
    drawn = set()
    steps = curves.steps
    thin: dict[str, Any] = {"drawstyle": "steps-post", "linewidth": 0.8, "alpha": 0.35}
    thin |= {"color": look["color"], "linestyle": look["linestyle"]}
    if len(curves.seeds) > 1:
        axes.plot(steps, curves.seeds.T, **thin)
        drawn.add("seed")
    if len(curves.repeats):
        every = max(1, len(steps) // 8)
        axes.plot(steps, curves.repeats.T, **thin | REPEAT, markevery=every)
        drawn.add("repeat")
    return drawn


def draw_mean(axes: Any, curves: GroupCurves, look: dict[str, Any], label: str) -> set[str]:
    """Draw the mean of a group with its interval, and marks where the number of seeds changes.

    All lines are steps: a value holds until the next one. So the mean of one seed is its line.

    Args:
      axes: matplotlib's axes.
      curves: the curves.
      look: the line style of the group.
      label: the label of the mean.

    Returns:
      The keys of `LEGEND` that were drawn.
    """
    drawn = set()
    steps, mean = curves.steps, curves.mean
    axes.fill_between(
        steps, mean.low, mean.high, step="post", color=look["color"], alpha=0.18, linewidth=0
    )
    bold: dict[str, Any] = {"drawstyle": "steps-post", "linewidth": 2.2, "markersize": 5}
    bold["markevery"] = max(1, len(steps) // 12)
    axes.plot(steps, mean.mean, **bold, **look, label=label)
    for name, at in zip(("end", "begin"), count_changes(mean.seeds), strict=True):
        if len(at):
            axes.plot(steps[at], mean.mean[at], **MARKS[name], color=look["color"], zorder=4)
            drawn.add(name)
    return drawn


def draw_curves(
    groups: list[RunGroup],
    quantity: str,
    title: str,
    out: Path,
    name: str,
    looks: dict[str, dict[str, Any]] | None = None,
) -> Path | None:
    """Draw the curves of a quantity, one for each group of runs that has the quantity.

    The line is the mean over the seeds that run at a step, and the band its 95% bootstrap interval;
    a mark shows where the number of seeds changes. Thin lines are single seeds and repeated runs,
    see `shows_seeds`. The means are also written as a CSV file.

    Args:
      groups: the groups of runs.
      quantity: a key of `QUANTITIES`.
      title: of the picture.
      out: the directory of the files.
      name: of the files, without suffix.
      looks: the line style of each group, by its name; by default chosen for these groups.

    Returns:
      The path of the PNG, with an SVG beside it; None if no group has this quantity.
    """
    looks = looks or group_styles(groups)
    found = [(group, group_curves(group, quantity)) for group in groups]
    there = [(group, curves) for group, curves in found if curves is not None]
    if not there:
        return None
    beside = len(there) > MOST_INSIDE
    columns = ceil((len(there) + len(LEGEND)) / LEGEND_ROWS) if beside else 0
    tall = 0.6 + 0.19 * min(len(there) + len(LEGEND), LEGEND_ROWS) if beside else 0.0
    figure, ((axes,),) = make_panels(1, 1, 7.2 + 3.8 * columns, max(4.2, tall))
    rows: list[list[Any]] = []
    drawn: set[str] = set()
    for group, curves in there:
        look = looks[group.name]
        if shows_seeds(group, groups):
            drawn |= draw_seeds(axes, curves, look)
        drawn |= draw_mean(axes, curves, look, curve_label(group, curves))
        cells = zip(curves.steps, *curves.mean, strict=True)
        rows += [
            [group.name, *("" if np.isnan(cell) else str(cell) for cell in row)] for row in cells
        ]
    write_csv(out / f"{name}.csv", ["runs", "step", "mean", "low", "high", "seeds"], rows)
    axes.set_title(title.replace("$", r"\$"))
    axes.set_ylabel(QUANTITIES[quantity].axis)
    label_steps_axis(axes)
    handles = axes.get_legend_handles_labels()[0]
    handles += [Line2D([], [], color="#4D4D4D", **LEGEND[key]) for key in LEGEND if key in drawn]
    place: dict[str, Any] = {"fontsize": 9}
    if beside:
        place = {"loc": "center left", "bbox_to_anchor": (1.01, 0.5), "fontsize": 8}
    axes.legend(handles=handles, frameon=False, ncols=max(1, columns), **place)
    return save_figure(figure, out, name)


def shows_seeds(group: RunGroup, groups: list[RunGroup]) -> bool:
    """Return True if the single seeds of a group are drawn: where they are few enough to be seen.

    They are at most `MOST_THIN` in the group, and at most `MOST_LINES` in all groups of the figure.
    """
    lines = sum(len(other.seeds) + len(other.repeats) for other in groups)
    return max(len(group.seeds), len(group.repeats)) <= MOST_THIN and lines <= MOST_LINES


def group_styles(groups: list[RunGroup]) -> dict[str, dict[str, Any]]:
    """Return a line style for each group, by its name; no two are the same."""
    return line_styles([(group.algo, group.name) for group in groups])


def group_title(group: RunGroup) -> str:
    """Return the name of a group, with the display name of its algorithm."""
    return display_title(group.algo, group.name)


def curve_label(group: RunGroup, curves: GroupCurves) -> str:
    """Return the label of a group: its name, and the number of its seeds and repeated runs."""
    shown = group_title(group).replace("$", r"\$")
    count, every, repeats = len(curves.seeds), len(group.seeds), len(curves.repeats)
    seeds = f"{count}{f' of {every}' if count < every else ''} seed{'s' if every > 1 else ''}"
    more = f" and {repeats} repeat{'s' if repeats > 1 else ''}" if repeats else ""
    return fill(f"{shown}, {seeds}{more}", WIDE, break_long_words=False)


def curve_notes(groups: list[RunGroup]) -> str:
    """Describe where seeds end, if they end at different steps, and what the figures leave out."""
    notes = []
    for group in groups:
        shown = group_title(group)
        if differ_in_steps(group.seeds):
            notes.append(f"{shown}: its seeds end at {format_ends(group.seeds)} million steps.")
        if group.repeats:
            again = ", ".join(str(seed.seed) for seed in group.repeats)
            notes.append(f"{shown}: repeated runs of seed {again}, which the mean leaves out.")
    hidden = [group for group in groups if not shows_seeds(group, groups)]
    if hidden:
        names = "all" if len(hidden) == len(groups) else ", ".join(map(group_title, hidden))
        notes.append(f"Single seeds and repeats are not drawn, because there are many: {names}.")
    return "\n".join(notes)
