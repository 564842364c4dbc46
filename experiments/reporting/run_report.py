"""The report page of any runs: learning curves, tables of the thesis, statistics over seeds."""

import time
from pathlib import Path

from ..config.schema import Config
from ..storage.read_runs import (
    RunData,
    RunGroup,
    RunReader,
    differing_settings,
    find_runs,
    group_runs,
    grouping_settings,
)
from ..system.display import ProgressBars
from ..system.errors import ConfigError
from ..system.files import safe_file_name
from .html_page import Section, Table, write_page
from .learning_curves import QUANTITIES, curve_notes, draw_curves, group_styles
from .thesis_tables import TABLES, improvement_table, seeds_table, thesis_table

REFRESH_SECONDS = 30  # between two reloads of a live page
THESIS_NOTE = (
    "Ours is over the given runs, with the number of seeds and steps shown; the thesis' after "
    "128 million steps (Atari) or 64 million (Procgen). ± is the standard deviation over runs. "
    "Empty entries were not run."
)
CURVES_NOTE = (
    "A bold line is the mean over the seeds that run at that step, with its 95% bootstrap "
    "interval. A value holds until the next one. Where a seed ends before others, or has its first "
    "value after others, a mark shows it, and the mean from there on is over fewer or more seeds."
)
REPEATS_NOTE = (
    "A repeat is a run with the settings and the seed of another run that has at least as many "
    "steps. Where single seeds are drawn, repeats are thin lines with circles. Means, intervals "
    "and tables leave them out, because a repeat is not another seed."
)


def drawn_quantities(groups: list[RunGroup]) -> list[str]:
    """Return the quantities that are drawn of an environment, keys of `QUANTITIES`."""
    seeds = [seed for group in groups for seed in group.seeds]
    scored = any((seed.episodes["score"] != seed.episodes["ext_return"]).any() for seed in seeds)
    return ["return", *(["score"] if scored else []), "intrinsic", "rooms"]


def environment_sections(groups: list[RunGroup], out: Path, bars: ProgressBars) -> list[Section]:
    """Draw the curves of each environment, and return a section for each.

    Args:
      groups: the groups of runs.
      out: the directory of the pictures.
      bars: where the progress is shown.
    """
    looks = group_styles(groups)
    own: dict[str, list[RunGroup]] = {}
    for group in groups:
        own.setdefault(group.env, []).append(group)
    notes = {env: "\n".join(filter(None, [CURVES_NOTE, curve_notes(own[env])])) for env in own}
    sections = {env: Section(env, notes[env]) for env in own}
    plan = [(env, quantity) for env in own for quantity in drawn_quantities(own[env])]
    for env, quantity in bars.track("drawing", plan):
        name = f"{safe_file_name(env)}-{quantity}"
        picture = draw_curves(own[env], quantity, env, out, name, looks)
        if picture is not None:
            caption = f"{env}: {QUANTITIES[quantity].axis}"
            sections[env].pictures.append((picture, caption))
    return list(sections.values())


def columns(runs: list[RunData]) -> list[str]:
    """Return the settings that differ between runs of one algorithm on one environment."""
    together: dict[tuple[str, str], list[Config]] = {}
    for run in runs:
        key = (run.config.env.name, run.config.algo.name)
        together.setdefault(key, []).append(run.config)
    return sorted({name for configs in together.values() for name in differing_settings(configs)})


def runs_section(runs: list[RunData], groups: list[RunGroup]) -> Section:
    """Make the section with the table of the runs that were read, and what differs between them."""
    repeats = {id(seed) for group in groups for seed in group.repeats}
    names = columns(runs)
    head = ["run", "environment", "algorithm", *names]
    head += ["seeds", "steps per seed", "finished", "repeats"]
    rows = []
    for run in runs:
        config = run.config
        own = grouping_settings(config)
        whole = run.steps >= config.iterations * config.rows
        name = [str(run.path), config.env.name, config.algo.name]
        name += [str(own.get(setting, "")) for setting in names]
        again = ", ".join(f"seed {seed.seed}" for seed in run.seeds if id(seed) in repeats)
        rows.append([*name, len(run.seeds), f"{run.steps:,}", "yes" if whole else "no", again])
    note = REPEATS_NOTE if repeats else ""
    return Section("Runs", note, tables=[Table(head, rows, name="runs")])


def report_sections(
    runs: list[RunData], left_out: list[tuple[Path, str]], out: Path, bars: ProgressBars
) -> list[Section]:
    """Make the sections of the page.

    Args:
      runs: the runs that could be read.
      left_out: the directories that could not be read, each with the reason.
      out: the directory of the pictures.
      bars: where the progress is shown.
    """
    groups = group_runs(runs)
    curves = environment_sections(groups, out, bars)
    beside = [thesis_table(table, groups) for table in TABLES]
    sections = [
        *curves,
        Section("Beside the thesis", THESIS_NOTE, tables=beside),
        Section("Over seeds", tables=[seeds_table(groups), improvement_table(groups, bars)]),
        runs_section(runs, groups),
    ]
    if left_out:
        sections.append(Section("Left out", tables=[Table(["directory", "why"], left_out)]))
    return sections


def write_report(
    paths: list[Path], out: Path, live: bool = False, reader: RunReader | None = None
) -> None:
    """Write the report page of all runs in these directories, in their current state.

    Args:
      paths: directories that are runs or contain runs at any depth, also behind symbolic links.
      out: the directory of the page `index.html` and of its pictures and tables.
      live: whether a browser reloads the page every `REFRESH_SECONDS`.
      reader: keeps what was read, for the next page about the same runs.

    Raises:
      ConfigError: no run could be read.
    """
    with ProgressBars() as bars:
        runs, left_out = find_runs(paths, reader, bars)
        for path, reason in left_out:
            print(f"left out: {path}: {reason}")
        if not runs:
            raise ConfigError(f"nothing to report in {', '.join(map(str, paths))}")
        out.mkdir(parents=True, exist_ok=True)
        sections = report_sections(runs, left_out, out, bars)
    lead = f"{time.strftime('%Y-%m-%d %H:%M')}. A step is one agent step of one environment; an "
    lead += "Atari step is four emulator frames."
    page = out / "index.html"
    write_page(page, "sndjax report", lead, sections, REFRESH_SECONDS if live else 0)
    print(f"page: {page.resolve()}", flush=True)
