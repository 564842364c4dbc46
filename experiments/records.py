"""What a run leaves: metrics.jsonl, episodes.csv, summary.json and TensorBoard events."""

import csv
import json
import math
from pathlib import Path
from typing import Any

from tensorboardX import SummaryWriter

from experiments.directory import replace
from experiments.episodes import Episode, Summary

COLUMNS = [name for name in Episode._fields if name != "rooms"]


class Records:
    """The log files of a run; opened again, they go on where its checkpoint stands."""

    def __init__(self, path: Path, seeds: list[int], rooms: bool, step: int):
        """Open the files.

        Args:
          path: the run directory.
          seeds: one per agent.
          rooms: whether episodes count rooms.
          step: rows collected so far; what stands in the files beyond them is taken out,
            because it will be collected again.
        """
        self.path, self.seeds = path, seeds
        self.columns = COLUMNS + (["rooms"] if rooms else [])
        self.summaries = [Summary() for _ in seeds]
        self.wall_seconds = 0.0
        self.transitions = [0 for _ in seeds]
        if step:
            self.rewind(step)
        self.metrics = (path / "metrics.jsonl").open("a")
        new = not (path / "episodes.csv").exists()
        self.episodes = (path / "episodes.csv").open("a", newline="")
        self.writer = csv.writer(self.episodes, lineterminator="\n")
        if new:
            self.writer.writerow(self.columns)
            self.episodes.flush()
        self.boards = [
            SummaryWriter(str(path / "tensorboard" / f"seed_{seed}"), purge_step=step or None)
            for seed in seeds
        ]

    def rewind(self, step: int) -> None:
        """Cut the files back to `step` rows and take in what remains."""
        index = {seed: i for i, seed in enumerate(self.seeds)}
        kept = []
        for line in (self.path / "metrics.jsonl").read_text().splitlines():
            try:
                entry = json.loads(line)
            except json.JSONDecodeError:
                continue  # half a line: the run was killed while it wrote it
            if entry["step"] <= step:
                kept.append(line)
                self.wall_seconds = entry["wall_seconds"]
                self.transitions[index[entry["seed"]]] = entry["transitions"]
        replace(self.path / "metrics.jsonl", "".join(f"{line}\n" for line in kept))
        kept = [",".join(self.columns)]
        for line in (self.path / "episodes.csv").read_text().splitlines()[1:]:
            cells = line.split(",")
            if len(cells) != len(self.columns) or int(cells[1]) > step:
                continue
            kept.append(line)
            seed, at, length, *figures = cells
            external, score, intrinsic = (float(x) for x in figures[:3])
            episode = Episode(int(seed), int(at), int(length), external, score, intrinsic)
            self.summaries[index[episode.seed]].add(episode)
        replace(self.path / "episodes.csv", "".join(f"{line}\n" for line in kept))

    def take_in(self, i: int, ended: list[Episode], entry: dict[str, Any]) -> dict[str, Any]:
        """Log one iteration of seed number i: its episodes and its line of metrics.

        Returns the line: the entry with the episodes' means and counts.
        """
        for episode in ended:
            self.summaries[i].add(episode)
            self.writer.writerow(episode[: len(self.columns)])
        mean = lambda name: sum(getattr(e, name) for e in ended) / len(ended) if ended else None
        head = {key: entry.pop(key) for key in ("iteration", "step", "transitions", "frames")}
        line = head | {
            "seed": self.seeds[i],
            "episodes": self.summaries[i].episodes,
            "ext_return": mean("ext_return"),
            "score": mean("score"),
            "last100_ext_return": self.summaries[i].last100,
        }
        line |= {key: finite(value) for key, value in entry.items()}
        self.metrics.write(json.dumps(line, allow_nan=False) + "\n")
        for key, value in line.items():
            if isinstance(value, float):
                self.boards[i].add_scalar(key, value, line["step"])
        return line

    def flush(self) -> None:
        """Hand everything written so far to the system."""
        self.metrics.flush()
        self.episodes.flush()

    def summarize(self, step: int) -> None:
        """Write summary.json for `step` rows per seed."""
        seeds = [
            {"seed": seed, "steps": step} | summary.figures() | {"wall_seconds": self.wall_seconds}
            for seed, summary in zip(self.seeds, self.summaries, strict=True)
        ]
        replace(self.path / "summary.json", json.dumps({"seeds": seeds}, indent=1) + "\n")

    def close(self) -> None:
        """Close the files."""
        self.metrics.close()
        self.episodes.close()
        for board in self.boards:
            board.close()


def finite(value: Any) -> Any:
    """JSON has no NaN and no infinity: they become null."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
