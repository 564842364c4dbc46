"""The tables of the trial, from the files of its rows."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from ..reporting.seed_statistics import (
    bootstrap_interval,
    interquartile_mean,
    joint_improvement,
    mean_improvement,
    pooled_interquartile_mean,
    probability_of_improvement,
)
from ..system.errors import ConfigError
from .chance import format_chance
from .protocol import Method, Protocol, Task
from .rows import row_path, run_command
from .tuning import Setting, rank

QUESTIONS = 2  # the primary ones, which share an error of one in twenty
Rows = dict[tuple[str, str], dict[str, Any]]  # by task and method


def read_rows(protocol: Protocol, out: Path) -> Rows:
    """Return the results of the rows that were run.

    Args:
      protocol: of the trial.
      out: the directory of its results.

    Raises:
      ConfigError: a row was run under another protocol.
    """
    found = {}
    for task, method in protocol.rows():
        path = row_path(out, "rows", task, method)
        if not path.exists():
            continue
        row = json.loads(path.read_text())
        setting = Setting(row["numbers"], row["choices"])
        if row["command"] != run_command(protocol, task, method, setting, protocol.seeds[0]):
            raise ConfigError(f"{path} was run under another protocol; move it away")
        row["search"] = search_result(row_path(out, "tuning", task, method))
        found[task.name, method.name] = row
    return found


def search_result(path: Path) -> tuple[float, float]:
    """Return mean score and mean coverage on the tuning seeds of the setting that was chosen.

    Args:
      path: the file of the search.
    """
    tried = json.loads(path.read_text())["tried"]
    most = max(len(row["solved"]) for row in tried)
    finalists = [row for row in tried if len(row["solved"]) == most]
    best = finalists[rank(finalists)[0]]
    return float(np.mean(best["solved"])), float(np.mean(best["coverage"]))


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
        own = format_chance(*chance[task.name]) if chance and task.name in chance else ""
        lines.append((task.title, cells if chance is None else [own, *cells]))
    titles = [method.title for method in methods]
    return table("task", titles if chance is None else ["random actions", *titles], lines)


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
    both = [t for t in tasks if {(t, method.name), (t, protocol.reference)} <= rows.keys()]
    values = lambda task, which: np.array(rows[task, which][name], float)
    return [(values(task, method.name), values(task, protocol.reference)) for task in both]


def answer_lines(protocol: Protocol, rows: Rows) -> list[str]:
    """Return the answers to the two primary questions, over the tasks whose rows are complete.

    Args:
      protocol: of the trial.
      rows: the results.
    """
    wanted = [*protocol.primary, protocol.reference]
    tasks = [t for t in protocol.tasks if all((t, name) in rows for name in wanted)]
    if not tasks:
        return ["No task is complete."]
    level = 1 - 0.05 / QUESTIONS
    values = lambda task, name: np.array(rows[task, name]["solved"], float)
    theirs = {task: values(task, protocol.reference) for task in tasks}
    every = [([values(t, name) for name in protocol.primary], theirs[t]) for t in tasks]
    best = lambda task: max(protocol.primary, key=lambda name: rows[task, name]["search"])
    chosen = [([values(task, best(task))], theirs[task]) for task in tasks]
    titles = ", ".join(protocol.methods[name].title for name in protocol.primary)
    questions = {
        f"P(a run of {titles} > a run of RND), mean over methods and tasks": every,
        "the same for the one of them that was best in the search of each task": chosen,
    }
    lines = []
    for question, groups in questions.items():
        value, interval = joint_improvement(groups, level)
        verdict = "yes" if interval[0] > 0.5 else "no" if interval[1] < 0.5 else "not shown"
        lines.append((question, [with_interval(value, interval), verdict]))
    missing = len(protocol.tasks) - len(tasks)
    note = f"{len(tasks)} tasks" + f"; {missing} are not complete" * (missing > 0)
    return table(f"{note}; intervals of {level:.1%}", ["found", "more than one half?"], lines)


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
            if not pairs or method.name == protocol.reference:
                continue
            ours, theirs = (
                pooled_interquartile_mean(list(side)) for side in zip(*pairs, strict=True)
            )
            improved = mean_improvement(pairs)
            covered = mean_improvement(paired(protocol, rows, method, kind, "coverage"))
            cells = [
                kind or "all",
                str(len(pairs)),
                with_interval(*ours),
                with_interval(*theirs),
                with_interval(*improved),
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


def improvement_table(protocol: Protocol, rows: Rows) -> list[str]:
    """Return the table of the probability that a run of a method solves more than one of RND.

    Args:
      protocol: of the trial.
      rows: the results.
    """
    methods = [m for m in protocol.methods.values() if m.name != protocol.reference]

    def cell(task: Task, method: Method) -> str:
        ours, theirs = rows.get((task.name, method.name)), rows.get((task.name, protocol.reference))
        if ours is None or theirs is None:
            return ""
        values = (np.array(row["solved"], float) for row in (ours, theirs))
        return f"{probability_of_improvement(*values):.2f}"

    lines = [
        (task.title, [cell(task, method) for method in methods])
        for task in protocol.tasks.values()
        if (task.name, protocol.reference) in rows
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
        means = [f"{value:.2f}" for value in (row["search"][0], np.mean(row["solved"]))]
        broken = str(row["finite"].count(False))
        lines.append(
            (title, [", ".join(numbers + chosen), *means, broken, f"{row['seconds']:.0f}"])
        )
    columns = [
        "setting",
        "mean in the search",
        "mean of the row",
        "not finite",
        "seconds, one core",
    ]
    return table("row", columns, lines)
