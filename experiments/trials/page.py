"""The page and the pictures of the trial, from the files of its rows."""

from pathlib import Path

import numpy as np

from ..reporting.plot_style import label_steps_axis, line_style, make_panels, save_figure
from ..reporting.seed_statistics import interquartile_mean
from ..system.files import write_atomically
from .chance import read_chance
from .protocol import Protocol
from .tables import (
    Rows,
    answer_lines,
    improvement_table,
    read_rows,
    result_table,
    setting_table,
    verdict_table,
)

PAGE = "rows.md"
PICTURES = "images"


def draw_rows(protocol: Protocol, rows: Rows, out: Path) -> None:
    """Draw every seed's solved episodes, and the curves, a panel for each task.

    Args:
      protocol: of the trial.
      rows: the results.
      out: the directory of the pictures.
    """
    tasks = [t for t in protocol.tasks.values() if any(key[0] == t.name for key in rows)]
    columns = min(4, len(tasks))
    height = -(-len(tasks) // columns)
    seeds, panels = make_panels(height, columns, 3.4 * columns, 2.6 * height, sharey=True)
    curves, others = make_panels(height, columns, 3.4 * columns, 2.4 * height, sharey=True)
    for task, axes, curve_axes in zip(tasks, panels.flat, others.flat, strict=False):
        methods = [m for m in protocol.methods.values() if (task.name, m.name) in rows]
        for i, method in enumerate(methods):
            row, style = rows[task.name, method.name], line_style(method.name)
            values = np.array(row["solved"])
            shift = np.linspace(-0.3, 0.3, len(values))
            axes.plot(i + shift, np.sort(values), ".", color=style["color"], ms=3)
            axes.plot([i - 0.4, i + 0.4], 2 * [interquartile_mean(values)], **style, lw=2)
            done, ended = (np.array(row["curve"][name], float) for name in ("solved", "episodes"))
            share = interquartile_mean(done / np.maximum(ended, 1))
            steps = row["steps"] * np.arange(1, len(share) + 1) / len(share)
            curve_axes.plot(steps, share, **style, label=method.title)
        axes.set(title=task.title, ylim=(-0.04, 1.04))
        axes.set_xticks(range(len(methods)), [m.title for m in methods], rotation=60, fontsize=7)
        curve_axes.set(title=task.title, ylim=(-0.04, 1.04))
        label_steps_axis(curve_axes)
    for one in (*panels[:, 0], *others[:, 0]):
        one.set_ylabel("solved episodes")
    for unused in (*panels.flat[len(tasks) :], *others.flat[len(tasks) :]):
        unused.set_visible(False)
    names = {line.get_label(): line for axes in others.flat for line in axes.get_lines()}
    curves.legend(list(names.values()), list(names), loc="outside lower center", ncols=2 * columns)
    save_figure(seeds, out, "seeds", vector=False)
    save_figure(curves, out, "curves", vector=False)


def machine_lines(rows: Rows) -> list[str]:
    """Return what computed the rows.

    Args:
      rows: the results.
    """
    keys = ("machine", "device", "python", "jax", "jaxlib", "flax", "optax", "numpy", "revision")
    found = {", ".join(f"{k} {row['versions'].get(k, '')}" for k in keys) for row in rows.values()}
    return [f"- {line}" for line in sorted(found)]


def write_page(protocol: Protocol, out: Path) -> None:
    """Write the tables and the pictures of the rows that were run.

    Args:
      protocol: of the trial.
      out: the directory of its results.
    """
    rows = read_rows(protocol, out)
    out.mkdir(parents=True, exist_ok=True)
    wanted = len(protocol.rows())
    lines = [
        "# The trial's rows",
        "",
        f"{len(rows)} of {wanted} rows; the question and the rules are in [trial.md](../trial.md).",
        "Written by `sndjax trial page=true` from the files in `rows/` and `tuning/`.",
    ]
    if rows:
        draw_rows(protocol, rows, out / PICTURES)
        lines += ["", "## The answer", "", *answer_lines(protocol, rows)]
        lines += ["", "## Each method against RND, intervals of 95%", ""]
        lines += verdict_table(protocol, rows)
        lines += ["", f"## Solved episodes: IQM of {len(protocol.seeds)} seeds, 95% interval", ""]
        lines += [
            *result_table(protocol, rows, "solved", read_chance(out)),
            "",
            "![All seeds](images/seeds.png)",
        ]
        lines += ["", "![Solved episodes over training](images/curves.png)"]
        lines += ["", "## The probability that a run solves more than one of RND", ""]
        lines += improvement_table(protocol, rows)
        lines += ["", "## Distinct places visited: IQM, 95% interval", ""]
        lines += result_table(protocol, rows, "coverage")
        lines += ["", "## Doors unlocked in an episode, mean over the training", ""]
        lines += result_table(protocol, rows, "progress")
        lines += ["", "## Settings", "", *setting_table(protocol, rows)]
        lines += ["", "## Machine and versions", "", *machine_lines(rows)]
    write_atomically(out / PAGE, "\n".join(lines) + "\n")
    print(f"{out / PAGE}: {len(rows)} of {wanted} rows")
