"""python -m experiments.report runs/ --out report: one page of any runs, finished or not.

Learning curves, the thesis' tables with our numbers beside its own, statistics over seeds: as one
HTML file with everything in it, and each part as PNG, SVG and CSV. With --live it is written again
every half minute, and the page loads itself anew.
"""

import sys
import time
from dataclasses import dataclass
from pathlib import Path

from experiments.arguments import read, usage
from experiments.options import ConfigError, option
from experiments.run import refuse

EVERY = 30  # seconds, with --live


@dataclass(frozen=True)
class Options:
    """What can be chosen."""

    out: str = option("report", "where the page goes")
    live: bool = option(False, "write it again every half minute, until Ctrl-C")


def sections(places: list[Path], out: Path):
    """The parts of the page.

    Raises:
      ConfigError: there is nothing to report.
    """
    from rich.progress import track

    from experiments.curves import QUANTITIES, draw
    from experiments.finished import find, grouped
    from experiments.page import Section, Table
    from experiments.tables import TABLES, improvement_table, seeds_table, thesis_table

    runs, left_out = find(places)
    if not runs:
        why = "; ".join(f"{path}: {reason}" for path, reason in left_out)
        raise ConfigError(f"nothing to report: {why}")
    groups = grouped(runs)
    found = []
    envs = list(dict.fromkeys(group.env for group in groups))
    for env in track(envs, "drawing", transient=True):
        own = [group for group in groups if group.env == env]
        wanted = ["return", "intrinsic", "rooms"]
        if any(
            (seed.episodes["score"] != seed.episodes["ext_return"]).any()
            for group in own
            for seed in group.seeds
        ):
            wanted.insert(1, "score")
        drawn = [
            (draw(own, q, env, out, f"{env}-{q}"), f"{env}: {QUANTITIES[q].axis}") for q in wanted
        ]
        found.append(Section(env, pictures=[(p, about) for p, about in drawn if p is not None]))
    if groups:
        tables = [thesis_table(table, groups) for table in TABLES]
        found.append(
            Section(
                "Beside the thesis",
                "Ours over the runs given, with how many seeds and steps they have; its own after "
                "128 million (Atari) or 64 million steps (Procgen). ± is the deviation over runs. "
                "What was not run is empty.",
                tables=tables,
            )
        )
        found.append(Section("Over seeds", tables=[seeds_table(groups), improvement_table(groups)]))
    listed = [
        [
            str(run.path),
            run.config.env.name,
            run.config.algo.name,
            len(run.seeds),
            f"{run.steps:,}",
            "yes" if run.steps >= run.config.iterations * run.config.rows else "no",
        ]
        for run in runs
    ]
    head = ["run", "environment", "algorithm", "seeds", "steps per seed", "finished"]
    found.append(Section("Runs", tables=[Table(head, listed, name="runs")]))
    if left_out:
        rows = [[str(path), reason] for path, reason in left_out]
        found.append(Section("Left out", tables=[Table(["directory", "why"], rows)]))
    return found, left_out


def main(arguments: list[str]) -> int:
    """Write the page, once or until Ctrl-C."""
    if not arguments or "--help" in arguments or "-h" in arguments:
        print(usage(str(__doc__), Options))
        return 0 if arguments else 2
    try:
        places, options = read(arguments, Options)
        if not places:
            raise ConfigError("say which directories: python -m experiments.report runs/")
        out = Path(options.out)
        while True:
            write(places, out, options.live)
            if not options.live:
                return 0
            time.sleep(EVERY)
    except (ConfigError, OSError) as error:
        return refuse(error)
    except KeyboardInterrupt:
        return 0


def write(places: list[Path], out: Path, live: bool) -> None:
    """The page as of now."""
    from experiments.page import write_page

    out.mkdir(parents=True, exist_ok=True)
    found, left_out = sections(places, out)
    for path, reason in left_out:
        print(f"left out: {path}: {reason}")
    lead = f"{time.strftime('%Y-%m-%d %H:%M')}. A step is one agent step of one environment; an "
    lead += "Atari step is four emulator frames."
    page = out / "index.html"
    write_page(page, "sndjax report", lead, found, EVERY if live else 0)
    print(f"page: {page.resolve()}", flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
