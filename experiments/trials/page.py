"""The tables and the pictures of the trial, from the files of its rows."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from ..reporting.plot_style import label_steps_axis, line_style, make_panels, save_figure
from ..reporting.seed_statistics import (
    bootstrap_interval,
    interquartile_mean,
    mean_improvement,
    pooled_interquartile_mean,
    probability_of_improvement,
)
from ..system.files import write_atomically
from .chance import format_chance, measure_chance
from .protocol import Method, Protocol, Task
from .rows import row_path

PAGE = "rows.md"
PICTURES = "images"
REFERENCE = "rnd"  # what others are compared with
Rows = dict[tuple[str, str], dict[str, Any]]  # by task and method


def read_rows(protocol: Protocol, out: Path) -> Rows:
    """Return the results of the rows that were run.

    Args:
      protocol: of the trial.
      out: the directory of its results.
    """
    paths = {(task.name, m.name): row_path(out, "rows", task, m) for task, m in protocol.rows()}
    return {key: json.loads(path.read_text()) for key, path in paths.items() if path.exists()}


def with_interval(value: float, interval: Any) -> str:
    """Return a number with its interval as text."""
    if interval is None:
        return f"{value:.2f}"
    return f"{value:.2f} [{interval[0]:.2f}, {interval[1]:.2f}]"


def table(corner: str, columns: list[str], lines: list[tuple[str, list[str]]]) -> list[str]:
    """Return the lines of a Markdown table.

    Args:
      corner: the title of the first column.
      columns: the titles of the others.
      lines: the first cell and the other cells of each row.
    """
    head = [f"| {corner} | {' | '.join(columns)} |", "|---|" + "---|" * len(columns)]
    return head + [f"| {first} | {' | '.join(cells)} |" for first, cells in lines]


def cell_of(row: dict[str, Any] | None, name: str) -> str:
    """Return the interquartile mean of a row's seeds with its interval; "" where it did not run.

    Args:
      row: the results; None: there are none.
      name: "solved", "coverage" or "progress".
    """
    if row is None:
        return ""
    values = np.array(row[name], float)
    value, interval = (
        float(interquartile_mean(values)),
        bootstrap_interval(values, interquartile_mean),
    )
    if name != "coverage":
        return with_interval(value, interval)
    return f"{value:.0f}" + (f" [{interval[0]:.0f}, {interval[1]:.0f}]" if interval else "")


def result_table(
    protocol: Protocol, rows: Rows, name: str, chance: dict[str, list[int]] | None = None
) -> list[str]:
    """Return the table of a result: a line for every task, a column for every method.

    Args:
      protocol: of the trial.
      rows: the results.
      name: "solved", "coverage" or "progress".
      chance: of random actions by task, for a column of its own; None: without it.
    """
    methods = list(protocol.methods.values())
    lines = []
    for task in protocol.tasks.values():
        if not any(key[0] == task.name for key in rows):
            continue
        cells = [cell_of(rows.get((task.name, method.name)), name) for method in methods]
        lines.append((task.title, [format_chance(*chance[task.name]), *cells] if chance else cells))
    titles = [method.title for method in methods]
    return table("task", ["random actions", *titles] if chance else titles, lines)


def paired(
    protocol: Protocol, rows: Rows, method: Method, kind: str | None, name: str
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return a method's results and the reference's on every task that both have run.

    Args:
      protocol: of the trial.
      rows: the results.
      method: the method.
      kind: of the tasks; None: all.
      name: of the result.
    """
    tasks = [task.name for task in protocol.tasks.values() if kind in (None, task.kind)]
    both = [t for t in tasks if (t, method.name) in rows and (t, REFERENCE) in rows]
    values = lambda task, which: np.array(rows[task, which][name], float)
    return [(values(task, method.name), values(task, REFERENCE)) for task in both]


def verdict_table(protocol: Protocol, rows: Rows) -> list[str]:
    """Return the table of what the trial asks: each method against the reference.

    Args:
      protocol: of the trial.
      rows: the results.
    """
    lines = []
    for kind in (None, *dict.fromkeys(task.kind for task in protocol.tasks.values())):
        for method in protocol.methods.values():
            pairs = paired(protocol, rows, method, kind, "solved")
            if not pairs or method.name == REFERENCE:
                continue
            ours, theirs = (
                pooled_interquartile_mean(list(side)) for side in zip(*pairs, strict=True)
            )
            chance = mean_improvement(pairs)
            covered = mean_improvement(paired(protocol, rows, method, kind, "coverage"))
            cells = [
                kind or "all",
                str(len(pairs)),
                with_interval(*ours),
                with_interval(*theirs),
                with_interval(*chance),
                with_interval(*covered),
            ]
            lines.append((method.title, cells))
    columns = [
        "tasks",
        "number",
        "solved, IQM",
        "RND's on the same",
        "P(more solved than RND)",
        "P(more places than RND)",
    ]
    return table("method", columns, lines)


def chance_table(protocol: Protocol, rows: Rows) -> list[str]:
    """Return the table of the probability that a run of a method solves more than one of RND.

    Args:
      protocol: of the trial.
      rows: the results.
    """
    methods = [m for m in protocol.methods.values() if m.name != REFERENCE]

    def cell(task: Task, method: Method) -> str:
        ours, theirs = rows.get((task.name, method.name)), rows.get((task.name, REFERENCE))
        if ours is None or theirs is None:
            return ""
        values = (np.array(row["solved"], float) for row in (ours, theirs))
        return f"{probability_of_improvement(*values):.2f}"

    lines = [
        (task.title, [cell(task, method) for method in methods])
        for task in protocol.tasks.values()
        if (task.name, REFERENCE) in rows
    ]
    return table("task", [method.title for method in methods], lines)


def setting_table(protocol: Protocol, rows: Rows) -> list[str]:
    """Return the table of the settings that were found.

    Args:
      protocol: of the trial.
      rows: the results.
    """
    lines = []
    for (task, method), row in rows.items():
        numbers = [f"{name}={value:.2g}" for name, value in row["numbers"].items()]
        chosen = [f"{name}={value}" for name, value in row["choices"].items()]
        title = f"{protocol.tasks[task].title}, {protocol.methods[method].title}"
        lines.append((title, [", ".join(numbers + chosen), f"{row['seconds']:.0f}"]))
    return table("row", ["setting", "seconds of its seeds on one core"], lines)


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
    wanted = len(protocol.rows())
    lines = [
        "# The trial's rows",
        "",
        f"{len(rows)} of {wanted} rows; the question and the rules are in [trial.md](../trial.md).",
        "Written by `sndjax trial page=true` from the files in `rows/` and `tuning/`.",
    ]
    if rows:
        draw_rows(protocol, rows, out / PICTURES)
        lines += ["", "## Against RND", "", *verdict_table(protocol, rows)]
        lines += ["", f"## Solved episodes: IQM of {len(protocol.seeds)} seeds, 95% interval", ""]
        chance = measure_chance(protocol, out)
        lines += [
            *result_table(protocol, rows, "solved", chance),
            "",
            "![All seeds](images/seeds.png)",
        ]
        lines += ["", "![Solved episodes over training](images/curves.png)"]
        lines += ["", "## The probability that a run solves more than one of RND", ""]
        lines += chance_table(protocol, rows)
        lines += ["", "## Distinct places visited: IQM, 95% interval", ""]
        lines += result_table(protocol, rows, "coverage")
        lines += ["", "## Doors unlocked in an episode, mean over the training", ""]
        lines += result_table(protocol, rows, "progress")
        lines += ["", "## Settings", "", *setting_table(protocol, rows)]
        lines += ["", "## Machine and versions", "", *machine_lines(rows)]
    write_atomically(out / PAGE, "\n".join(lines) + "\n")
    print(f"{out / PAGE}: {len(rows)} of {wanted} rows")
