"""Reading of run directories, finished or not, also with incomplete or damaged files."""

import csv
import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..config.cell_options import CELL_GROUPS, cell_options
from ..config.config_checks import validate_config
from ..config.run_settings import run_settings
from ..config.saved import CONFIG
from ..config.schema import Config
from ..system.display import ProgressBars
from ..system.errors import ConfigError
from .read_configs import ConfigReader
from .run_search import find_run_directories


class SeedData(NamedTuple):
    """The training data of one agent."""

    seed: int
    episodes: dict[str, np.ndarray]  # columns of episodes.csv, float64[E]
    metrics: dict[str, np.ndarray]  # of metrics.jsonl, float64[I]; NaN where a value is missing


class RunData(NamedTuple):
    """The content of one run directory."""

    path: Path
    config: Config
    seeds: list[SeedData]
    notes: list[str]  # parts of the files that could not be used

    @property
    def steps(self) -> int:
        """Return the number of steps per seed so far."""
        counts = [int(seed.metrics["step"][-1]) for seed in self.seeds if "step" in seed.metrics]
        return max(counts, default=0)


def complete_lines(path: Path) -> tuple[list[str], bool]:
    """Return the complete lines of a log, and whether an incomplete line follows.

    A line is incomplete while it is being written, or if it was cut.
    """
    whole, _, rest = path.read_text().rpartition("\n")
    return whole.splitlines(), bool(rest)


def read_run(path: Path, configs: ConfigReader | None = None) -> RunData:
    """Read the content of a run directory.

    Args:
      path: the run directory.
      configs: the reader of its configuration, if many runs are read.

    Raises:
      ValueError: the directory cannot be read; the message says why in a few words.
    """
    config = validate_config((configs or ConfigReader()).read(path / CONFIG))
    notes: list[str] = []
    try:
        lines, cut = complete_lines(path / "metrics.jsonl")
        rows, also_cut = complete_lines(path / "episodes.csv")
    except FileNotFoundError as error:
        raise ValueError(f"no {Path(error.filename).name} yet") from None
    except UnicodeDecodeError:
        raise ValueError("a log is not text") from None
    for name, short in (("metrics.jsonl", cut), ("episodes.csv", also_cut)):
        if short:
            notes.append(f"the last line of {name} is half written and left out")
    entries = parse_metrics(lines)
    episodes = parse_episodes(rows)
    seeds = []
    for seed in config.seeds:
        own = [entry for entry in entries if entry.get("seed") == seed]
        if entries and not own:
            notes.append(f"seed {seed} has no line in metrics.jsonl and is left out")
        mine = {name: column[episodes["seed"] == seed] for name, column in episodes.items()}
        names = {name for entry in own for name in entry} - {"seed"}
        figures = {n: np.array([as_float(e.get(n)) for e in own]) for n in sorted(names)}
        seeds.append(SeedData(seed, mine, figures))
    return RunData(path, config, seeds, notes)


def as_float(value: Any) -> float:
    """Return a value as a float; NaN if the value is not a number."""
    return float(value) if isinstance(value, (int, float)) else float("nan")


def parse_metrics(lines: list[str]) -> list[dict[str, Any]]:
    """Parse the lines of metrics.jsonl into objects.

    Raises:
      ValueError: a line is not an object, or has no step.
    """
    entries = []
    for i, line in enumerate(lines):
        try:
            entry = json.loads(line)
        except ValueError:
            entry = None
        if not isinstance(entry, dict) or not isinstance(entry.get("step"), int):
            raise ValueError(f"line {i + 1} of metrics.jsonl is no line of metrics")
        entries.append(entry)
    return entries


def parse_episodes(rows: list[str]) -> dict[str, np.ndarray]:
    """Parse the lines of episodes.csv into columns.

    Raises:
      ValueError: there is no header, a line does not fit the header, or a column is missing.
    """
    if not rows:
        raise ValueError("episodes.csv is empty")
    try:
        head, *body = csv.reader(io.StringIO("\n".join(rows)))
        table = np.array(body, float).reshape(len(body), len(head))
    except (ValueError, csv.Error):
        raise ValueError("episodes.csv holds a line that does not fit its head") from None
    if {"seed", "step", "length", "ext_return", "score", "int_return"} - set(head):
        raise ValueError("episodes.csv has other columns")
    return dict(zip(head, table.T, strict=True))


class RunReader:
    """A reader of many runs, which reads a run again only after its files have changed."""

    def __init__(self) -> None:
        """Start without any run in memory."""
        self.configs = ConfigReader()
        self.known: dict[Path, tuple[list[tuple[int, int]], RunData]] = {}

    def read(self, path: Path) -> RunData:
        """Read a run directory, as `read_run`.

        Raises:
          ValueError: the directory cannot be read.
        """
        stamps = []
        for name in (CONFIG, "metrics.jsonl", "episodes.csv"):
            try:
                status = (path / name).stat()
            except FileNotFoundError:
                continue
            stamps.append((status.st_mtime_ns, status.st_size))
        before = self.known.get(path)
        if before is not None and before[0] == stamps:
            return before[1]
        run = read_run(path, self.configs)
        self.known[path] = stamps, run
        return run


def find_runs(
    places: Sequence[Path], reader: RunReader | None = None, bars: ProgressBars | None = None
) -> tuple[list[RunData], list[tuple[Path, str]]]:
    """Find every run in these directories and below them, also behind symbolic links.

    Args:
      places: the directories.
      reader: keeps what was read, for the next call.
      bars: where the progress is shown.

    Returns:
      The runs, each once, and each path that was left out, completely or in part, with the reason.
    """
    reader = reader or RunReader()
    paths, left_out = find_in_places(places)
    runs = []
    shown: Iterable[Path] = bars.track("reading runs", paths) if bars and paths else paths
    for path in shown:
        try:
            run = reader.read(path)
        except (ValueError, ConfigError, OSError) as error:
            left_out.append((path, str(error)))
            continue
        left_out += [(path, note) for note in run.notes]
        if run.steps:
            runs.append(run)
        else:
            left_out.append((path, "no iteration is done yet"))
    return runs, left_out


def find_in_places(places: Sequence[Path]) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Return the run directories in several places, each real directory once, and the problems."""
    found: dict[Path, Path] = {}
    left_out: list[tuple[Path, str]] = []
    for place in places:
        if not place.is_dir():
            left_out.append((place, "there is no such directory"))
            continue
        paths, problems = find_run_directories(place)
        left_out += problems
        if not paths:
            left_out.append((place, "no run in it"))
        for path in paths:
            found.setdefault(path.resolve(), path)
    return list(found.values()), left_out


class RunGroup(NamedTuple):
    """The runs of one algorithm, with one set of settings, on one environment."""

    env: str
    algo: str  # as configured
    name: str  # with the settings that differ from other groups of this algorithm
    seeds: list[SeedData]  # the longest run of each seed
    config: Config
    repeats: Sequence[SeedData] = ()  # the other runs of these seeds


def group_runs(runs: list[RunData]) -> list[RunGroup]:
    """Group the seeds of runs with the same settings.

    Where an algorithm has several groups, their names contain the settings that differ. Where a
    seed was run several times, its longest run is kept as the seed and the others are `repeats`.
    """
    kinds: dict[tuple[str, str], dict[str, list[RunData]]] = {}
    for run in runs:
        own = grouping_settings(run.config)
        of = kinds.setdefault((run.config.env.name, run.config.algo.name), {})
        of.setdefault(json.dumps(own, sort_keys=True), []).append(run)
    groups = []
    for (env, algo), variants in sorted(kinds.items()):
        parsed = [json.loads(text) for text in variants]
        differing = differing_settings([runs[0].config for runs in variants.values()])
        for own, same in zip(parsed, variants.values(), strict=True):
            told = " ".join(
                f"{name.removeprefix('algo.')}={own[name]}" for name in differing if name in own
            )
            seeds, repeats = split_repeats(
                [seed for run in same for seed in run.seeds if "step" in seed.metrics]
            )
            name = f"{algo} ({told})" if told else algo
            groups.append(RunGroup(env, algo, name, seeds, same[0].config, repeats))
    return groups


def differing_settings(configs: list[Config]) -> list[str]:
    """Return the names of the settings that have several values, sorted.

    An option of a constructor counts where a run has another value than the default of its
    algorithm: the defaults of two signals or objectives differ without anyone's choice.
    """
    values: dict[str, set[str]] = {}
    changed: set[str] = set()
    for config in configs:
        defaults = {name: entry.default for name, entry in cell_options(config.algo).items()}
        for name, value in grouping_settings(config).items():
            values.setdefault(name, set()).add(json.dumps(value, sort_keys=True))
            if name in defaults and value != defaults[name]:
                changed.add(name)
    several = {name for name, found in values.items() if len(found) > 1}
    own = {name for name in several if name.partition(".")[0] in CELL_GROUPS}
    return sorted((several - own) | (own & changed))


def split_repeats(seeds: list[SeedData]) -> tuple[list[SeedData], list[SeedData]]:
    """Split the runs of seeds into the longest run of each seed and all others, sorted by seed."""
    longest_first = sorted(seeds, key=lambda seed: (seed.seed, -seed.metrics["step"][-1]))
    best: dict[int, SeedData] = {}
    others = []
    for seed in longest_first:
        if seed.seed in best:
            others.append(seed)
        else:
            best[seed.seed] = seed
    return list(best.values()), others


def grouping_settings(config: Config) -> dict[str, Any]:
    """Return the settings that must match for two runs to be aggregated over seeds."""
    own = run_settings(config)
    free = ("seed", "num_seeds", "checkpoint_every", "on_nan")
    return {name: value for name, value in own.items() if name not in free}


def read_summary(run: Path) -> list[dict[str, Any]]:
    """Return the entry of every seed in a run's summary.json, or [] without a valid file."""
    try:
        seeds = json.loads((run / "summary.json").read_text())["seeds"]
    except (OSError, ValueError, KeyError, TypeError):
        return []
    return seeds if isinstance(seeds, list) else []
