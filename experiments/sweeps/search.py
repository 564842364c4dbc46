"""The results of a search over settings: the sorted trials, and a plot over two keys."""

from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser

from ..reporting.plot_style import make_panels, save_figure
from .job_status import summary_metric
from .jobs import read_jobs


def finished_trials(
    directory: Path, keys: tuple[str, ...], figure: str
) -> list[tuple[float, list[float]]]:
    """Return the metric and the values of every finished trial, the best first.

    Args:
      directory: the directory of the sweep.
      keys: the keys whose values the search chose.
      figure: the name of the metric that the search maximised.
    """
    found = []
    for job, _ in read_jobs(directory):
        steps, value = summary_metric(directory / job.name, figure)
        if steps >= job.total and value is not None:
            parsed = OverridesParser.create().parse_overrides(job.overrides)
            values: Any = {override.get_key_element(): override.value() for override in parsed}
            found.append((value, [values[key] for key in keys]))
    return sorted(found, key=lambda trial: -trial[0])


def search_report(directory: Path, keys: tuple[str, ...], figure: str) -> str:
    """Return the trials as text; write search.csv and, for two keys, a picture.

    Args:
      directory: the directory of the sweep.
      keys: the keys whose values the search chose.
      figure: the name of the metric that the search maximised.
    """
    found = finished_trials(directory, keys, figure)
    out = directory / "report"
    out.mkdir(exist_ok=True)
    rows = [[short(value), *map(short, values)] for value, values in found]
    lines = [",".join([figure, *keys]), *(",".join(row) for row in rows)]
    (out / "search.csv").write_text("\n".join(lines) + "\n")
    numbers = all(isinstance(v, int | float) for _, values in found for v in values)
    if len(keys) == 2 and found and numbers:
        plot_trials(found, keys, figure, out)
    widths = [
        max(len(job) for job in column) for column in zip([figure, *keys], *rows, strict=True)
    ]
    shown = ["  ".join(f"{c:>{w}}" for c, w in zip(row, widths, strict=True)) for row in rows]
    head = "  ".join(f"{c:>{w}}" for c, w in zip([figure, *keys], widths, strict=True))
    return "\n".join([head, *shown, f"in {out}"])


def short(value: Any) -> str:
    """Return a number with four digits, and a word or a list as it is, without commas."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return f"{value:.4g}" if is_number else str(value).replace(",", "")


def plot_trials(
    found: list[tuple[float, list[float]]], keys: tuple[str, ...], figure: str, out: Path
) -> None:
    """Draw a scatter plot of the trials, coloured by metric.

    Args:
      found: the metric and the values of every trial.
      keys: the keys of the two values.
      figure: the name of the metric.
      out: the directory of the picture.
    """
    drawn, grid = make_panels(1, 1)
    axes = grid[0, 0]
    at = lambda k: [values[k] for _, values in found]
    points = axes.scatter(at(0), at(1), c=[value for value, _ in found], cmap="viridis_r", s=60)
    axes.set(xscale="log", yscale="log", xlabel=keys[0], ylabel=keys[1])
    axes.set_title(f"{len(found)} trials, the best {found[0][0]:.3g}")
    drawn.colorbar(points, label=figure)
    save_figure(drawn, out, "search")
