"""The page of what is known on a GPU, made from the files of the steps that were run."""

from pathlib import Path
from statistics import median
from typing import Any

from ..reporting.thesis_tables import format_published, thesis_numbers
from ..storage.run_logs import read_lines
from ..system.files import write_atomically
from .gpu_steps import STEPS

PAGE = "suite.md"
GOAL = 0.75  # of the rate of random actions


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the whole rows of a .jsonl file, not one that was cut off; [] if there is none."""
    return list(read_lines(path, path.read_bytes().rfind(b"\n") + 1)) if path.exists() else []


def number_table(rows: list[dict[str, Any]]) -> list[str]:
    """Return the table of differences from float32 on a CPU."""
    if not rows:
        return ["Not run."]
    figured = [name for row in rows for name, value in row.items() if isinstance(value, float)]
    names = list(dict.fromkeys(figured))
    lines = [f"| max abs difference / max abs value | {' | '.join(names)} |"]
    lines.append("|---|" + "---|" * len(names))
    for row in rows:
        figures = " | ".join(f"{row[name]:.1e}" if name in row else "" for name in names)
        failed = f" (failed: {row['error']})" if "error" in row else ""
        lines.append(f"| {row['case']}{failed} | {figures} |")
    return lines


def rate_table(rates: dict[str, float]) -> list[str]:
    """Return the table of rates: each beside that of random actions, and the hours of 128M steps.

    Args:
      rates: steps per second of all seeds together, by the names of steps.
    """
    lines = ["| | steps/s | to random actions | hours for 128M steps of each seed |"]
    lines.append("|---|---|---|---|")
    pool = rates.get("pool")
    for step in STEPS[1:]:
        found = rates.get(step.name)
        if found is None:
            lines.append(f"| {step.about} | not run | | |")
            continue
        share = f"{found / pool:.2f}" if pool and step.of_game else ""
        hours = f"{step.seeds * 128e6 / found / 3600:.1f}" if step.of_game else ""
        lines.append(f"| {step.about} | {found:,.0f} | {share} | {hours} |")
    if pool and "overlap" in rates:
        met = "met" if rates["overlap"] / pool >= GOAL else "not met"
        lines += ["", f"Goal, {GOAL:.0%} of the rate of random actions with overlap=1: {met}."]
    return lines


def run_table(out: Path) -> list[str]:
    """Return the table of the runs of the last step: how far they came, beside the thesis' means.

    Args:
      out: the directory with a file for each.
    """
    thesis = {**thesis_numbers("5.6"), **thesis_numbers("5.8")}
    lines = ["| run | steps | steps/s, median | last-100 return | the thesis' mean, 64M steps |"]
    lines.append("|---|---|---|---|---|")
    for path in sorted(out.glob("run-*.jsonl")):
        rows = read_rows(path)
        if not rows:
            continue
        _, env, algo = path.stem.split("-", 2)
        last, published = rows[-1], thesis.get((env, algo, "mean_episode_reward"))
        # The last iteration of a run may collect nothing, and the first one compiles.
        rates = [row["steps_per_second"] for row in rows[1:-1] if "steps_per_second" in row]
        shown = last.get("last100_ext_return")
        lines.append(
            f"| {env} {algo} | {last['step']:,} "
            f"| {format(median(rates), ',.0f') if rates else ''} "
            f"| {'' if shown is None else format(shown, '.2f')} "
            f"| {'' if published is None else format_published(published)} |"
        )
    pictures = [f"![{path.stem}]({path.name})" for path in sorted(out.glob("*-return.png"))]
    return [*lines, "", *pictures] if len(lines) > 2 else ["Not run."]


def newest_of_one_device(out: Path) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of every step that was measured on the device of the newest one.

    Args:
      out: the directory.
    """
    places = [out / f"{step.name}.jsonl" for step in STEPS]
    found = {path.stem: read_rows(path) for path in places}
    there = [path for path in places if found[path.stem]]
    if not there:
        return {}
    where = ("device", "cores", "small")
    newest = found[max(there, key=lambda path: path.stat().st_mtime).stem][-1]
    same = lambda row: all(row[name] == newest[name] for name in where)
    kept = {name: [row for row in rows if same(row)] for name, rows in found.items()}
    return {name: rows for name, rows in kept.items() if rows}


def write_page(out: Path, command: str) -> None:
    """Write the page of all files in a directory.

    Args:
      out: the directory.
      command: that made them.
    """
    files = newest_of_one_device(out)
    rates = {
        name: rows[-1]["steps_per_second"]
        for name, rows in files.items()
        if "steps_per_second" in rows[-1]
    }
    first = next((rows[0] for rows in files.values()), None)
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
        *number_table(files.get("numbers", [])),
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
