"""The logs of a run: metrics.jsonl, episodes.csv, times.jsonl, summary.json, TensorBoard events.

Only times.jsonl depends on the clock.
"""

import json
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..system.files import write_atomically
from ..system.process import rss_mb
from .append_log import AppendLog, LogMark, read_until_mark
from .episodes import Episode, EpisodeSummary
from .tensorboard import TensorBoardWriter

COLUMNS = [name for name in Episode._fields if name != "rooms"]
LOGS = ("metrics.jsonl", "episodes.csv", "times.jsonl")


def check_logs(path: Path, seeds: list[int], marks: dict[str, LogMark]) -> None:
    """Check that the logs begin with the content that they had when they were marked.

    Args:
      path: the run directory.
      seeds: the seed of each agent.
      marks: the marks of the logs, by file name.

    Raises:
      ValueError: a log is missing or has changed, or holds a line of another run.
    """
    for name in LOGS:
        if name != LOGS[2] or name in marks:  # earlier versions had the times in metrics.jsonl
            read_until_mark(path / name, marks[name])
    known = {"step": int, "transitions": int}
    for line in read_lines(path / LOGS[0], marks[LOGS[0]]["bytes"]):
        fits = all(isinstance(line.get(key), kind) for key, kind in known.items())
        if not fits or line.get("seed") not in seeds:
            raise ValueError(f"{LOGS[0]} holds a line of another run")
    for episode in read_episodes(path, marks[LOGS[1]]["bytes"]):
        if episode.seed not in seeds:
            raise ValueError(f"{LOGS[1]} holds a line of another run")
    end = marks[LOGS[2]]["bytes"] if LOGS[2] in marks else 0
    for line in read_lines(path / LOGS[2], end) if end else ():
        if not isinstance(line.get("wall_seconds"), float):
            raise ValueError(f"{LOGS[2]} holds a line of another run")


def read_lines(path: Path, end: int) -> Iterator[dict[str, Any]]:
    """Yield the lines of a .jsonl file, before the byte `end`.

    Raises:
      ValueError: a line is not a JSON object.
    """
    with path.open("rb") as file:
        while file.tell() < end:
            line = json.loads(file.readline())
            if not isinstance(line, dict):
                raise ValueError(f"{path.name} holds a line that is no object")
            yield line


def read_episodes(path: Path, end: int) -> Iterator[Episode]:
    """Yield the episodes of episodes.csv before the byte `end`, without their rooms.

    Raises:
      ValueError: a line is not an episode.
    """
    with (path / LOGS[1]).open("rb") as file:
        file.readline()
        while file.tell() < end:
            seed, step, length, *figures = file.readline().decode().split(",")
            external, score, intrinsic = (float(x) for x in figures[:3])
            yield Episode(int(seed), int(step), int(length), external, score, intrinsic)


class RunLogs:
    """The log files of a run; a resumed run continues them from its checkpoint."""

    def __init__(self, path: Path, seeds: list[int], rooms: bool, marks: dict[str, LogMark]):
        """Open the files.

        Args:
          path: the run directory.
          seeds: the seed of each agent.
          rooms: whether episodes count rooms.
          marks: the marks of the logs at the checkpoint that the run resumes from, if any; later
            content is cut off, because it will be collected again.

        Raises:
          ValueError: a log is missing, or its content before the mark has changed.
        """
        self.path, self.seeds = path, seeds
        self.summaries = [EpisodeSummary() for _ in seeds]
        self.wall_seconds = 0.0
        self.transitions = [0 for _ in seeds]
        self.metrics, self.episodes, self.times = (
            AppendLog(path / name, marks.get(name)) for name in LOGS
        )
        self.tensorboard = TensorBoardWriter(path / "tensorboard", seeds)
        self.columns = COLUMNS + (["rooms"] if rooms else [])
        if self.episodes.size:
            self.restore_counts()
        else:
            self.write_row(self.columns)
        self.flush()

    def read_back(self) -> Iterator[dict[str, Any]]:
        """Yield the lines of metrics.jsonl so far, each with the times of its iteration."""
        times = read_lines(self.path / LOGS[2], self.times.size)
        own: dict[str, Any] = {"iteration": 0}
        for line in read_lines(self.path / LOGS[0], self.metrics.size):
            # An earlier version's line holds its times itself.
            while "wall_seconds" not in line and own["iteration"] < line["iteration"]:
                own = next(times)
            yield line if "wall_seconds" in line else line | own

    def restore_counts(self) -> None:
        """Restore the counts, the summaries and the TensorBoard events from the existing logs."""
        for line in self.read_back():
            self.wall_seconds = line["wall_seconds"]
            self.transitions[self.seeds.index(line["seed"])] = line["transitions"]
        begun = time.time() - self.wall_seconds
        for line in self.read_back():
            self.tensorboard.add(line, begun + line["wall_seconds"])
        for episode in read_episodes(self.path, self.episodes.size):
            self.summaries[self.seeds.index(episode.seed)].add(episode)

    def write_row(self, cells: Any) -> None:
        """Write a line of episodes.csv; no cell needs quotes."""
        self.episodes.write(",".join(str(cell) for cell in cells) + "\n")

    def log_times(self, times: dict[str, Any]) -> dict[str, Any]:
        """Log what the clock says of one iteration, and return the line.

        Args:
          times: its number, seconds and rates.
        """
        line = {key: finite_or_none(value) for key, value in times.items()}
        line |= {"wall_seconds": self.wall_seconds, "rss_mb": rss_mb()}
        self.times.write(json.dumps(line, allow_nan=False) + "\n")
        return line

    def log_iteration(
        self, i: int, ended: list[Episode], entry: dict[str, Any], times: dict[str, Any]
    ) -> dict[str, Any]:
        """Log one iteration of one seed: its episodes and its line of metrics.

        Args:
          i: the index of the seed.
          ended: the episodes that ended in this iteration.
          entry: the metrics of this iteration; keys are removed from it.
          times: its line of times.

        Returns:
          The line: the entry with the means and the count of the episodes, and the times.
        """
        for episode in ended:
            self.summaries[i].add(episode)
            self.write_row(episode[: len(self.columns)])
        mean = lambda name: sum(getattr(e, name) for e in ended) / len(ended) if ended else None
        head = {key: entry.pop(key) for key in ("iteration", "step", "transitions", "frames")}
        line = head | {
            "seed": self.seeds[i],
            "episodes": self.summaries[i].episodes,
            "ext_return": mean("ext_return"),
            "score": mean("score"),
            "last100_ext_return": self.summaries[i].last100,
        }
        line = {key: finite_or_none(value) for key, value in (line | entry).items()}
        self.metrics.write(json.dumps(line, allow_nan=False) + "\n")
        self.tensorboard.add(line | times, time.time())
        return line | times

    def flush(self) -> None:
        """Flush all log files to the system."""
        for log in (self.metrics, self.episodes, self.times, self.tensorboard):
            log.flush()

    def manifest(self) -> dict[str, Any]:
        """Fsync the logs and return the entries that describe them in a checkpoint's manifest."""
        last = [summary.last100 for summary in self.summaries if summary.last100 is not None]
        logs = (self.metrics, self.episodes, self.times)
        marks = {name: log.mark() for name, log in zip(LOGS, logs, strict=True)}
        return {"logs": marks, "last100": finite_or_none(sum(last) / len(last)) if last else None}

    def summarize(self, step: int) -> None:
        """Write summary.json for `step` rows per seed."""
        seeds = [
            {"seed": seed, "steps": step}
            | {key: finite_or_none(value) for key, value in summary.figures().items()}
            | {"wall_seconds": self.wall_seconds}
            for seed, summary in zip(self.seeds, self.summaries, strict=True)
        ]
        write_atomically(self.path / "summary.json", json.dumps({"seeds": seeds}, indent=1) + "\n")

    def close(self) -> None:
        """Close the files."""
        for log in (self.metrics, self.episodes, self.times, self.tensorboard):
            log.close()


def finite_or_none(value: Any) -> Any:
    """Return None for NaN and infinity, which JSON does not have; otherwise the value."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def mean_over_seeds(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Average each metric over the seeds that report it."""
    mean = {}
    for key in lines[0]:
        values = [line[key] for line in lines if line[key] is not None]
        mean[key] = sum(values) / len(values) if values else None
    return mean | {"step": lines[0]["step"]}
