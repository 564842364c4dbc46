"""The table of a sweep: the last return of every seed, the mean with its interval, a picture."""

import json
from collections.abc import Iterable
from math import isfinite, nan
from pathlib import Path
from statistics import mean, median
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np

from ..config.saved import CONFIG
from ..config.schema import Config
from ..storage.read_configs import ConfigReader
from ..storage.read_runs import find_in_places, read_summary
from ..system.display import ProgressBars
from ..system.errors import ConfigError
from ..system.files import write_atomically
from .plot_style import line_style, make_panels, save_figure
from .seed_statistics import bootstrap_interval
from .seed_steps import format_million_steps

WIDE = 44  # characters in a line of a row's label in the picture
CELL = ("algo.objective=", "algo.signal=")
Summaries = dict[str, dict[str, Any]]  # row_name(...) -> the seed's entry of summary.json


class Row(NamedTuple):
    """One algorithm with one set of settings on one environment."""

    env: str
    name: str
    seeds: dict[int, dict[str, Any]]

    def last(self) -> list[float]:
        """Return the return of the last 100 episodes of each seed, sorted by seed.

        NaN for a seed in which no episode has ended.
        """
        found = [self.seeds[seed]["last100_ext_return"] for seed in sorted(self.seeds)]
        return [nan if value is None else value for value in found]


def mean_with_interval(values: list[float]) -> str:
    """Format the mean of the finite values with its 95% bootstrap interval.

    >>> mean_with_interval([1.0, 1.0, nan]), mean_with_interval([0.5]), mean_with_interval([nan])
    ('1.00 [1.00, 1.00]', '0.50', '-')
    """
    there = np.array([value for value in values if isfinite(value)])
    if not len(there):
        return "-"
    found = bootstrap_interval(there)
    return f"{there.mean():.2f}" + (f" [{found[0]:.2f}, {found[1]:.2f}]" if found else "")


def read_summaries(path: Path) -> Any:
    """Read a JSON file of summaries.

    Raises:
      ConfigError: the file is not valid JSON.
    """
    try:
        return json.loads(path.read_text())
    except ValueError:
        raise ConfigError(f"{path} is not valid JSON") from None


class Loaded(NamedTuple):
    """What was found in the places that were given."""

    summaries: Summaries  # of all finished runs
    unfinished: list[Path]  # the directories of the runs that are not finished
    left_out: list[tuple[Path, str]]  # places that could not be searched, with the reason


def load_summaries(places: list[Path], bars: ProgressBars | None = None) -> Loaded:
    """Load the summaries of all finished runs, each run once, also behind symbolic links.

    Args:
      places: JSON files of summaries, or directories that contain runs at any depth.
      bars: where the progress is shown.

    Raises:
      ConfigError: two runs have the same name, or a file is not valid JSON or no configuration.
    """
    found = Loaded({}, [], [])
    configs = ConfigReader()

    def add(of: Path, more: Summaries) -> None:
        for name in more:
            if name in found.summaries:
                raise ConfigError(f"{of} is a second run called {name}")
        found.summaries.update(more)

    for place in places:
        if place.suffix == ".json":
            add(place, read_summaries(place))
    runs, problems = find_in_places([place for place in places if place.suffix != ".json"])
    found.left_out.extend(problems)
    shown: Iterable[Path] = bars.track("reading runs", runs) if bars and runs else runs
    for run in shown:
        config, seeds = configs.read(run / CONFIG), read_summary(run)
        if seeds and seeds[0]["steps"] >= config.total_steps:
            name = run.resolve().name  # that of the link says nothing about the settings
            add(run, {row_name(config, name, seed["seed"]): seed for seed in seeds})
        else:
            found.unfinished.append(run)
    return found


def row_name(config: Config, directory: str, seed: int) -> str:
    """Return the name of a seed's row: <env>/<algo>/<seed>, then the other swept options.

    A cell of the grid is named by its objective and its signal, "vicreg+noveld".

    Args:
      config: of the run.
      directory: the name of the run directory, which lists the swept options.
      seed: the seed.
    """
    algo = config.algo
    name = algo.name if algo.name != "grid" else f"{algo.objective}+{algo.signal}"
    swept = [s for s in directory.split(",")[1:] if not s.startswith(CELL)]
    return "/".join([config.env.name, name, ",".join([str(seed), *swept])])


def table_rows(summaries: Summaries) -> list[Row]:
    """Group the seeds of the same settings into rows, in the order of the summaries."""
    found: dict[tuple[str, str], dict[int, dict[str, Any]]] = {}
    for name, summary in summaries.items():
        env, algo, last = name.rsplit("/", 2)
        settings = last.partition(",")[2].replace("algo.", "").replace(",", " ")
        key = env, f"{algo} {settings}".strip()
        found.setdefault(key, {})[summary["seed"]] = summary
    return [Row(env, name, seeds) for (env, name), seeds in found.items()]


def markdown_table(summaries: Summaries, goal: float) -> list[str]:
    r"""Return the lines of the Markdown table.

    Args:
      summaries: of all finished runs.
      goal: the return that a seed must reach to be counted.

    >>> run = {"seed": 0, "last100_ext_return": 1.0, "mean_ext_return": 0.5, "wall_seconds": 9.4}
    >>> print("\n".join(markdown_table({"Car/rnd/0": run}, 0.9)))
    | Car | seed 0 | mean [95%] | at least 0.9 | mean of all episodes | median s |
    |---|---|---|---|---|---|
    | `rnd` | 1.00 | 1.00 | 1 of 1 | 0.50 | 9 |
    """
    lines: list[str] = []
    shown = None
    for row in table_rows(summaries):
        seeds = sorted(row.seeds)
        if (row.env, seeds) != shown:
            shown = row.env, seeds
            numbers = [f"seed {seeds[0]}", *map(str, seeds[1:])]
            head = [row.env, *numbers, "mean [95%]", f"at least {goal:g}"]
            head += ["mean of all episodes", "median s"]
            lines += [""] * bool(lines) + [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
        last, of = row.last(), list(row.seeds.values())
        cells = [
            f"`{row.name}`",
            *(f"{value:.2f}".replace("nan", "-") for value in last),
            mean_with_interval(last),
            f"{sum(value >= goal for value in last)} of {len(last)}",
            f"{mean(seed['mean_ext_return'] or 0.0 for seed in of):.2f}",
            f"{median(seed['wall_seconds'] for seed in of):.0f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return lines + unequal_steps(table_rows(summaries))


def unequal_steps(rows: list[Row]) -> list[str]:
    """Return a line for each row whose seeds end at different steps, after an empty line."""
    lines = []
    for row in rows:
        steps = [seed["steps"] for seed in row.seeds.values() if "steps" in seed]
        if len(set(steps)) > 1:
            ends = format_million_steps(steps)
            lines.append(f"`{row.name}` on {row.env}: the seeds end at {ends} million steps.")
    return ["", *lines] if lines else []


def draw_seeds(summaries: Summaries, goal: float, path: Path) -> None:
    """Draw a dot for every seed, a bar for the mean, and a line for its 95% bootstrap interval.

    Every environment has a separate panel.

    Args:
      summaries: of all finished runs.
      goal: the return at which a vertical line is drawn.
      path: of the PNG, without suffix.
    """
    found = table_rows(summaries)
    envs = list(dict.fromkeys(row.env for row in found))
    label = lambda row: fill(row.name, WIDE, break_long_words=False)
    tall = lambda env: sum(1 + label(row).count("\n") for row in found if row.env == env)
    most = max(map(tall, envs))
    figure, ((*grid,),) = make_panels(1, len(envs), 1.5 + 4.2 * len(envs), 1.3 + 0.3 * most)
    for axes, env in zip(grid, envs, strict=True):
        own = [row for row in found if row.env == env][::-1]
        for at, row in enumerate(own):
            colour, last = line_style(row.name.split()[0])["color"], row.last()
            there = [value for value in last if isfinite(value)]
            axes.barh(at, mean(there or [0.0]), color=colour, alpha=0.25, height=0.7)
            if len(there) > 1:
                axes.plot(
                    bootstrap_interval(np.array(there)), [at, at], color="#4D4D4D", linewidth=1.2
                )
            axes.plot(last, [at] * len(last), "o", color=colour, markersize=5, alpha=0.8)
        axes.axvline(goal, color="#7F7F7F", linewidth=0.8, linestyle=":")
        axes.set_yticks(range(len(own)), [label(row) for row in own], fontsize=9)
        axes.set_xlim(left=-0.02 * max(1.0, axes.get_xlim()[1]))
        axes.set_xlabel("external return, last 100 episodes")
        axes.set_title(env, fontsize=10)
    save_figure(figure, path.parent, path.name, vector=False)


def write_summaries(summaries: Summaries, path: Path) -> None:
    """Write the summaries as JSON, one line for each run, so that diffs are short."""
    lines = [f" {json.dumps(name)}: {json.dumps(run)}" for name, run in summaries.items()]
    write_atomically(path, "{\n" + ",\n".join(lines) + "\n}\n")
