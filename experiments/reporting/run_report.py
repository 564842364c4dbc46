"""The report page of any runs: learning curves, tables of the thesis, statistics over seeds."""

import time
from pathlib import Path

from ..storage.read_runs import RunData, RunGroup, find_runs, group_runs
from ..system.display import ProgressBars
from ..system.errors import ConfigError
from ..system.files import safe_file_name
from .html_page import Section, Table, write_page
from .learning_curves import QUANTITIES, draw_curves
from .thesis_tables import TABLES, improvement_table, seeds_table, thesis_table

REFRESH_SECONDS = 30  # between two reloads of a live page
THESIS_NOTE = (
    "Ours is over the given runs, with the number of seeds and steps shown; the thesis' after "
    "128 million steps (Atari) or 64 million (Procgen). ± is the standard deviation over runs. "
    "Empty entries were not run."
)


def environment_section(env: str, groups: list[RunGroup], out: Path) -> Section:
    """Draw the curves of one environment, and return them as a section.

    Args:
      env: the name of the environment.
      groups: the groups of runs in this environment.
      out: the directory of the pictures.
    """
    seeds = [seed for group in groups for seed in group.seeds]
    scored = any((seed.episodes["score"] != seed.episodes["ext_return"]).any() for seed in seeds)
    pictures = []
    for quantity in ("return", *(["score"] if scored else []), "intrinsic", "rooms"):
        name = f"{safe_file_name(env)}-{quantity}"
        picture = draw_curves(groups, quantity, env, out, name)
        if picture is not None:
            pictures.append((picture, f"{env}: {QUANTITIES[quantity].axis}"))
    return Section(env, pictures=pictures)


def runs_section(runs: list[RunData]) -> Section:
    """Make the section with the table of the runs that were read."""
    head = ["run", "environment", "algorithm", "seeds", "steps per seed", "finished"]
    rows = []
    for run in runs:
        config = run.config
        whole = run.steps >= config.iterations * config.rows
        name = [str(run.path), config.env.name, config.algo.name]
        rows.append([*name, len(run.seeds), f"{run.steps:,}", "yes" if whole else "no"])
    return Section("Runs", tables=[Table(head, rows, name="runs")])


def report_sections(
    runs: list[RunData], left_out: list[tuple[Path, str]], out: Path
) -> list[Section]:
    """Make the sections of the page.

    Args:
      runs: the runs that could be read.
      left_out: the directories that could not be read, each with the reason.
      out: the directory of the pictures.
    """
    groups = group_runs(runs)
    envs = list(dict.fromkeys(group.env for group in groups))
    with ProgressBars() as bars:
        own = lambda env: [group for group in groups if group.env == env]
        curves = [environment_section(env, own(env), out) for env in bars.track("drawing", envs)]
    beside = [thesis_table(table, groups) for table in TABLES]
    sections = [
        *curves,
        Section("Beside the thesis", THESIS_NOTE, tables=beside),
        Section("Over seeds", tables=[seeds_table(groups), improvement_table(groups)]),
        runs_section(runs),
    ]
    if left_out:
        sections.append(Section("Left out", tables=[Table(["directory", "why"], left_out)]))
    return sections


def write_report(paths: list[Path], out: Path, live: bool = False) -> None:
    """Write the report page of all runs in these directories, in their current state.

    Args:
      paths: directories that are runs or contain runs at any depth.
      out: the directory of the page `index.html` and of its pictures and tables.
      live: whether a browser reloads the page every `REFRESH_SECONDS`.

    Raises:
      ConfigError: no run could be read.
    """
    runs, left_out = find_runs(paths)
    for path, reason in left_out:
        print(f"left out: {path}: {reason}")
    if not runs:
        raise ConfigError(f"nothing to report in {', '.join(map(str, paths))}")
    out.mkdir(parents=True, exist_ok=True)
    lead = f"{time.strftime('%Y-%m-%d %H:%M')}. A step is one agent step of one environment; an "
    lead += "Atari step is four emulator frames."
    page = out / "index.html"
    sections = report_sections(runs, left_out, out)
    write_page(page, "sndjax report", lead, sections, REFRESH_SECONDS if live else 0)
    print(f"page: {page.resolve()}", flush=True)
