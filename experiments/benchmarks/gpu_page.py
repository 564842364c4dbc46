"""The page of what is known on a GPU, made from the files of the steps that were run."""

import json
from pathlib import Path
from typing import Any

from ..system.files import write_atomically
from .gpu_steps import STEPS

PAGE = "suite.md"
GOAL = 0.75  # of the rate of random actions


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the whole rows of a step's file; [] if there is none."""
    rows = []
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            rows.append(json.loads(line))
        except ValueError:
            break
    return rows


def number_table(rows: list[dict[str, Any]]) -> list[str]:
    """Return the table of differences from float32 on a CPU."""
    if not rows:
        return ["Not run."]
    names = [name for name in rows[0] if isinstance(rows[0][name], float)]
    lines = [f"| max abs difference / max abs value | {' | '.join(names)} |"]
    lines.append("|---|" + "---|" * len(names))
    for row in rows:
        figures = " | ".join(f"{row[name]:.1e}" if name in row else "" for name in names)
        lines.append(f"| {row['case']} | {figures} |")
    return lines


def rate_table(rates: dict[str, float]) -> list[str]:
    """Return the table of rates: each beside that of random actions, and the hours of 128M steps.

    Args:
      rates: steps per second of all seeds together, by the names of steps.
    """
    lines = ["| | steps/s | to random actions | hours for 128M steps |", "|---|---|---|---|"]
    pool = rates.get("pool")
    for step in STEPS[1:]:
        found = rates.get(step.name)
        if found is None:
            lines.append(f"| {step.about} | not run | | |")
            continue
        share = f"{found / pool:.2f}" if pool and step.of_game else ""
        hours = f"{128e6 / found / 3600:.1f}" if step.of_game else ""
        lines.append(f"| {step.about} | {found:,.0f} | {share} | {hours} |")
    if pool and "overlap" in rates:
        met = "met" if rates["overlap"] / pool >= GOAL else "not met"
        lines += ["", f"Goal, {GOAL:.0%} of the rate of random actions with overlap=1: {met}."]
    return lines


def run_table(out: Path) -> list[str]:
    """Return the table of the runs of the last step: how far they came.

    Args:
      out: the directory with a file for each.
    """
    lines = ["| run | steps | steps/s at the end | last-100 return |", "|---|---|---|---|"]
    for path in sorted(out.glob("run-*.jsonl")):
        rows = read_rows(path)
        if rows:
            last = rows[-1]
            shown = last.get("last100_ext_return")
            rate = last.get("steps_per_second")
            lines.append(
                f"| {path.stem.removeprefix('run-')} | {last['step']:,} "
                f"| {'' if rate is None else format(rate, ',.0f')} "
                f"| {'' if shown is None else format(shown, '.2f')} |"
            )
    return lines if len(lines) > 2 else ["Not run."]


def write_page(out: Path, command: str) -> None:
    """Write the page of all files in a directory.

    Args:
      out: the directory.
      command: that made them.
    """
    files = {step.name: read_rows(out / f"{step.name}.jsonl") for step in STEPS}
    rates = {
        name: rows[-1]["steps_per_second"]
        for name, rows in files.items()
        if rows and "steps_per_second" in rows[-1]
    }
    first = next((rows[0] for rows in files.values() if rows), None)
    where = "Not run: no GPU was there."
    if first is not None:
        versions = ", ".join(f"{name} {value}" for name, value in first["versions"].items())
        where = f"Device: {first['device']} beside {first['cores']} cores. Versions: {versions}."
        if first["small"]:
            where += " **These are small tasks on a CPU, to try the command.**"
    lines = [
        "# On a GPU",
        "",
        f"    {command}",
        "",
        "Every measurement is a process of its own; the files of this directory hold their rows.",
        where,
        "",
        "## Numbers against float32 on a CPU",
        "",
        *number_table(files["numbers"]),
        "",
        "## Whole iterations of snd_std on Venture, and environments in JAX",
        "",
        *rate_table(rates),
        "",
        "## Procgen's exploration levels, as many steps as fit",
        "",
        *run_table(out),
        "",
    ]
    write_atomically(out / PAGE, "\n".join(lines))
