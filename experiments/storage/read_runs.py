"""Reading of run directories, finished or not, also with incomplete or damaged files."""

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..config.saved import CONFIG, read_saved, run_settings
from ..config.schema import Config
from ..config.validation import validate_config
from ..system.errors import ConfigError


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
        """The number of steps per seed so far."""
        counts = [int(seed.metrics["step"][-1]) for seed in self.seeds if "step" in seed.metrics]
        return max(counts, default=0)


def complete_lines(path: Path) -> tuple[list[str], bool]:
    """Return the complete lines of a log, and whether an incomplete line follows.

    A line is incomplete while it is being written, or if it was cut.
    """
    whole, _, rest = path.read_text().rpartition("\n")
    return whole.splitlines(), bool(rest)


def read_run(path: Path) -> RunData:
    """Read the content of a run directory.

    Raises:
      ValueError: the directory cannot be read; the message says why in a few words.
    """
    config = validate_config(read_saved(path / CONFIG).config)
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


def find_runs(places: Sequence[Path]) -> tuple[list[RunData], list[tuple[Path, str]]]:
    """Find every run in these directories and below them.

    Returns:
      The runs, and each path that was left out, completely or in part, with the reason.
    """
    found: dict[Path, RunData] = {}
    left_out: list[tuple[Path, str]] = []
    for place in places:
        if not place.is_dir():
            left_out.append((place, "there is no such directory"))
            continue
        configs = sorted(place.rglob(CONFIG))
        if not configs:
            left_out.append((place, "no run in it"))
        for path in (config.parent for config in configs):
            if path.resolve() in found:
                continue
            try:
                run = read_run(path)
            except (ValueError, ConfigError, OSError) as error:
                left_out.append((path, str(error)))
                continue
            left_out += [(path, note) for note in run.notes]
            if run.steps:
                found[path.resolve()] = run
            else:
                left_out.append((path, "no iteration is done yet"))
    return list(found.values()), left_out


class RunGroup(NamedTuple):
    """The runs of one algorithm, with one set of settings, on one environment."""

    env: str
    algo: str  # as configured
    name: str  # with the settings that differ from other groups of this algorithm
    seeds: list[SeedData]
    config: Config

    @property
    def steps(self) -> tuple[int, int]:
        """The smallest and the largest number of steps of a seed."""
        counts = [int(seed.metrics["step"][-1]) for seed in self.seeds]
        return min(counts), max(counts)


def group_runs(runs: list[RunData]) -> list[RunGroup]:
    """Group the seeds of runs with the same settings.

    Where an algorithm has several groups, their names contain the settings that differ.
    """
    kinds: dict[tuple[str, str], dict[str, list[RunData]]] = {}
    for run in runs:
        own = grouping_settings(run.config)
        of = kinds.setdefault((run.config.env.name, run.config.algo.name), {})
        of.setdefault(json.dumps(own, sort_keys=True), []).append(run)
    groups = []
    for (env, algo), variants in sorted(kinds.items()):
        parsed = [json.loads(text) for text in variants]
        differing = sorted(
            name for name in parsed[0] if any(other[name] != parsed[0][name] for other in parsed)
        )
        for own, same in zip(parsed, variants.values(), strict=True):
            told = " ".join(f"{name.removeprefix('algo.')}={own[name]}" for name in differing)
            seeds = longest_run_per_seed(
                [seed for run in same for seed in run.seeds if "step" in seed.metrics]
            )
            name = f"{algo} ({told})" if told else algo
            groups.append(RunGroup(env, algo, name, seeds, same[0].config))
    return groups


def longest_run_per_seed(seeds: list[SeedData]) -> list[SeedData]:
    """Keep the longest run of each seed."""
    best: dict[int, SeedData] = {}
    for seed in seeds:
        known = best.get(seed.seed)
        if known is None or seed.metrics["step"][-1] > known.metrics["step"][-1]:
            best[seed.seed] = seed
    return [best[number] for number in sorted(best)]


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
