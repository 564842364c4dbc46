"""The tables of the thesis with our numbers beside them, and tables of statistics over seeds."""

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..storage.read_runs import RunGroup, SeedData
from ..system.display import ProgressBars
from .html_page import Table
from .plot_style import display_title
from .seed_statistics import bootstrap_interval, interquartile_mean, mean_improvement
from .seed_steps import differ_in_steps, format_ends

THESIS = Path(__file__).parents[1] / "data" / "thesis.csv"
TABLES = {
    "5.6": "external return per episode, mean over all training episodes, SND",
    "5.7": "best episode's game score, Atari",
    "5.8": "external return per episode, mean over all training episodes, ICM and SP",
}


class Published(NamedTuple):
    """A number of the thesis; `std` is over the runs of the thesis, NaN if it gives none."""

    value: float
    std: float


def thesis_numbers(table: str) -> dict[tuple[str, str, str], Published]:
    """Return the numbers of one table, by environment, algorithm and quantity.

    >>> thesis_numbers("5.6")["Climber", "snd_vic", "mean_episode_reward"]
    Published(value=6.62, std=3.24)
    """
    with THESIS.open(newline="") as file:
        return {
            (row["env"], row["algo"], row["quantity"]): Published(
                float(row["value"]), float(row["std"] or "nan")
            )
            for row in csv.DictReader(file)
            if row["table"] == table
        }


def mean_return(seed: SeedData) -> float:
    """Return the mean external return of all training episodes; NaN if none has ended."""
    returns = seed.episodes["ext_return"]
    return float(returns.mean()) if len(returns) else float("nan")


def best_score(seed: SeedData) -> float:
    """Return the game score of the best episode; NaN if none has ended."""
    scores = seed.episodes["score"]
    return float(scores.max()) if len(scores) else float("nan")


def mean_and_std(values: list[float]) -> str:
    """Format the mean and the population standard deviation of the finite values.

    The text is empty if there are none.

    >>> mean_and_std([1.0, 3.0]), mean_and_std([float("nan")])
    ('2.00 ± 1.00', '')
    """
    finite = np.array([value for value in values if np.isfinite(value)])
    return f"{finite.mean():.2f} ± {finite.std():.2f}" if len(finite) else ""


def format_published(number: Published) -> str:
    """Format a number as the thesis prints it."""
    std_text = "" if np.isnan(number.std) else f" ± {number.std:.10g}"
    return f"{number.value:.10g}{std_text}"


def thesis_table(table: str, groups: list[RunGroup]) -> Table:
    """Make one of `TABLES`: every number of the thesis, and ours if such runs exist."""
    quantity = best_score if table == "5.7" else mean_return
    rows = []
    known = thesis_numbers(table)
    for (env, algo, _), number in known.items():
        ours: list[RunGroup | None] = [g for g in groups if (g.env, g.algo) == (env, algo)]
        for group in ours or [None]:
            cells = ["", "", ""]
            if group is not None:
                found = [value for value in map(quantity, group.seeds) if np.isfinite(value)]
                cells = [mean_and_std(found), str(len(found)), format_ends(group.seeds)]
            name = algo if group is None else group.name
            rows.append([env, display_title(algo, name), *cells, format_published(number)])
    head = ["environment", "algorithm", "ours", "seeds", "steps, millions", "thesis"]
    return Table(head, rows, f"Table {table}: {TABLES[table]}", f"table-{table}")


def seeds_table(groups: list[RunGroup]) -> Table:
    """Make the table of each group's statistics over seeds.

    They are the interquartile mean with its 95% interval, the mean and standard deviation over
    seeds of the last 100 episodes, the last step of each seed, and the repeated runs.
    """
    rows = []
    for group in groups:
        found = np.array([mean_return(seed) for seed in group.seeds])
        found = found[np.isfinite(found)]
        last = [
            float(np.mean(s.episodes["ext_return"][-100:]))
            for s in group.seeds
            if len(s.episodes["ext_return"])
        ]
        interval = bootstrap_interval(found, interquartile_mean)
        rows.append(
            [
                group.env,
                display_title(group.algo, group.name),
                str(len(found)),
                f"{interquartile_mean(found):.3g}" if len(found) else "",
                "" if interval is None else f"{interval[0]:.3g} to {interval[1]:.3g}",
                mean_and_std(last),
                format_ends(group.seeds),
                str(len(group.repeats)),
            ]
        )
    head = ["environment", "algorithm", "seeds", "interquartile mean", "95% interval", "last 100"]
    head += ["seeds end at, million steps", "repeats left out"]
    caption = "External return per episode, over all episodes of each seed until its last step; "
    caption += "last 100: the last episodes before it"
    return Table(head, rows, caption, "seeds")


def seeds_of(groups: list[RunGroup], env: str) -> list[SeedData]:
    """Return the seeds of all groups on one environment."""
    return [seed for group in groups if group.env == env for seed in group.seeds]


def improvement_table(groups: list[RunGroup], bars: ProgressBars | None = None) -> Table:
    """Make the table of the probability that a run of the row beats a run of the column.

    A cell is the mean over the environments that both groups have, and is empty if there is none.

    Args:
      groups: the groups of runs.
      bars: where the progress is shown.
    """
    returns: dict[str, dict[str, np.ndarray]] = {}
    for group in groups:
        found = np.array([mean_return(seed) for seed in group.seeds])
        returns.setdefault(group.name, {})[group.env] = found[np.isfinite(found)]
    rows = []
    names = list(returns)
    shown: Iterable[str] = names if bars is None else bars.track("comparing", names)
    for ours in shown:
        own, cells = returns[ours], []
        for theirs, other in returns.items():
            shared = [e for e in own if e in other and len(own[e]) and len(other[e])]
            if ours == theirs or not shared:
                cells.append("")
                continue
            value, interval = mean_improvement([(own[e], other[e]) for e in shared])
            around = f" ({interval[0]:.2f} to {interval[1]:.2f})" if interval else ""
            cells.append(f"{value:.2f}{around}")
        rows.append([ours, *cells])
    caption = "Probability of improvement: a run of the row beats one of the column (95% interval)"
    envs = {group.env for group in groups}
    if any(differ_in_steps(seeds_of(groups, env)) for env in envs):
        caption += "; not all runs have the same number of steps, see the table above"
    return Table(["", *returns], rows, caption, "improvement")
