"""python -m experiments.report runs/ --out report: one page of any runs, finished or not.

Learning curves, the thesis' tables with our numbers beside its own, statistics over seeds: as one
HTML file with everything in it, and each part as PNG, SVG and CSV. With --live it is written again
every half minute, and the page loads itself anew.
"""

import re
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.arguments import command
from experiments.options import ConfigError, option

EVERY = 30  # seconds, with --live


@dataclass(frozen=True)
class Options:
    """What can be chosen."""

    out: str = option("report", "where the page goes")
    live: bool = option(False, "write it again every half minute, until Ctrl-C")


def of_environment(env: str, groups: list[Any], out: Path) -> Any:
    """The curves of one environment."""
    from experiments.curves import QUANTITIES, draw
    from experiments.page import Section

    seeds = [seed for group in groups for seed in group.seeds]
    scored = any((seed.episodes["score"] != seed.episodes["ext_return"]).any() for seed in seeds)
    pictures = []
    for quantity in ("return", *(["score"] if scored else []), "intrinsic", "rooms"):
        plain = re.sub(r"[^A-Za-z0-9_-]", "-", env)
        picture = draw(groups, quantity, env, out, f"{plain}-{quantity}")
        if picture is not None:
            pictures.append((picture, f"{env}: {QUANTITIES[quantity].axis}"))
    return Section(env, pictures=pictures)


def of_runs(runs: list[Any]) -> Any:
    """A table of what was read."""
    from experiments.page import Section, Table

    head = ["run", "environment", "algorithm", "seeds", "steps per seed", "finished"]
    rows = []
    for run in runs:
        config = run.config
        whole = run.steps >= config.iterations * config.rows
        name = [str(run.path), config.env.name, config.algo.name]
        rows.append([*name, len(run.seeds), f"{run.steps:,}", "yes" if whole else "no"])
    return Section("Runs", tables=[Table(head, rows, name="runs")])


def sections(runs: list[Any], left_out: list[tuple[Path, str]], out: Path) -> list[Any]:
    """The parts of the page."""
    from experiments.finished import grouped
    from experiments.page import Section, Table
    from experiments.progress import Bars
    from experiments.tables import TABLES, improvement_table, seeds_table, thesis_table

    groups = grouped(runs)
    envs = list(dict.fromkeys(group.env for group in groups))
    with Bars() as bars:
        own = lambda env: [group for group in groups if group.env == env]
        found = [of_environment(env, own(env), out) for env in bars.over("drawing", envs)]
    return [
        *found,
        Section(
            "Beside the thesis",
            "Ours is over the runs given, of as many seeds and steps as stand beside it; the "
            "thesis' after 128 million steps (Atari) or 64 million (Procgen). ± is the deviation "
            "over runs. What was not run is empty.",
            tables=[thesis_table(table, groups) for table in TABLES],
        ),
        Section("Over seeds", tables=[seeds_table(groups), improvement_table(groups)]),
        of_runs(runs),
        *(
            [Section("Left out", tables=[Table(["directory", "why"], left_out)])]
            if left_out
            else []
        ),
    ]


def write(places: list[Path], out: Path, live: bool) -> None:
    """The page as of now.

    Raises:
      ConfigError: there is nothing to report.
    """
    from experiments.finished import find
    from experiments.page import write_page

    runs, left_out = find(places)
    for path, reason in left_out:
        print(f"left out: {path}: {reason}")
    if not runs:
        raise ConfigError(f"nothing to report in {', '.join(map(str, places))}")
    lead = f"{time.strftime('%Y-%m-%d %H:%M')}. A step is one agent step of one environment; an "
    lead += "Atari step is four emulator frames."
    page = out / "index.html"
    write_page(page, "sndjax report", lead, sections(runs, left_out, out), EVERY if live else 0)
    print(f"page: {page.resolve()}", flush=True)


def work(places: list[Path], options: Options) -> None:
    """Write the page, once or until Ctrl-C."""
    if not places:
        raise ConfigError("say which directories: python -m experiments.report runs/")
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    while options.live:
        try:
            write(places, out, live=True)
        except ConfigError as error:  # nothing yet
            print(error, flush=True)
        time.sleep(EVERY)
    write(places, out, live=False)


def main(arguments: list[str]) -> int:
    """The command."""
    return command(str(__doc__), Options, work, arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
