"""Metrics of a trained agent: return, score, length and rooms over whole episodes."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from ..reporting.seed_statistics import bootstrap_interval
from ..system.display import ProgressBars
from .players import MAX_STEPS, PlayedEpisode, cut_message, load_players, play_episodes


def episode_metrics(played: list[PlayedEpisode]) -> dict[str, np.ndarray]:
    """Return the metrics of each episode by name, float64[E]."""
    found = {
        "return": np.array([episode.reward.sum(dtype=np.float64) for episode in played]),
        "score": np.array([episode.score.sum(dtype=np.float64) for episode in played]),
        "length": np.array([float(len(episode.action)) for episode in played]),
    }
    if any(episode.room.any() for episode in played):
        found["rooms"] = np.array([float(len(np.unique(episode.room))) for episode in played])
    return found


def evaluate_run(
    run: Path,
    episodes: int,
    greedy: bool,
    seed: int,
    trust: tuple[str, ...] = (),
    max_steps: int = MAX_STEPS,
) -> list[dict[str, Any]]:
    """Play episodes with the agent of every seed of a run, and return the metrics of each seed.

    Args:
      run: the run directory.
      episodes: the number of episodes of each seed, played in parallel.
      greedy: take the most probable action instead of sampling one.
      seed: the seed of the environments.
      trust: the code that the run's configuration may name, see `load_players`.
      max_steps: the longest episode; longer ones are cut.

    Returns:
      For each seed: `seed`, `iteration`, `complete` (the number of episodes that ended), and for
      each metric its mean, its maximum and the 95% bootstrap interval of its mean (missing for a
      single episode). If episodes were cut: `note`, which says so.

    Raises:
      ConfigError: no agent can be loaded, or its environment cannot be made.
    """
    lines = []
    with ProgressBars() as bars:
        for player in load_players(run, trust):
            name = f"seed {player.seed}"

            def report(steps: int, ended: int, name: str = name) -> None:
                bars.update(name, ended, episodes, f"episodes, step {steps:,}")

            played = play_episodes(player, episodes, greedy, seed, False, report, max_steps)
            line: dict[str, Any] = {"seed": player.seed, "iteration": player.iteration}
            line["complete"] = sum(episode.complete for episode in played)
            if note := cut_message(played, max_steps):
                line["note"] = f"{note}; they count as far as they went"
            for name, values in episode_metrics(played).items():
                line[name] = {"mean": float(values.mean()), "max": float(values.max())}
                band = bootstrap_interval(values)
                if band is not None:
                    line[name]["interval"] = [float(x) for x in band]
            lines.append(line)
    return lines


def print_metrics(lines: list[dict[str, Any]], policy: str, episodes: int) -> None:
    """Print the metrics of every seed, and as the last line a JSON object.

    Args:
      lines: the result of `evaluate_run`.
      policy: the way in which actions were chosen.
      episodes: the number of episodes of each seed.
    """
    for line in lines:
        complete = f"{line['complete']} of {episodes} episodes complete"
        print(f"seed {line['seed']}, iteration {line['iteration']}, {policy}, {complete}")
        if "note" in line:
            print(f"  {line['note']}")
        for name in ("return", "score", "length", "rooms"):
            if name in line:
                found = line[name]
                ends = found.get("interval")
                band = f"  95% {ends[0]:.3f} to {ends[1]:.3f}" if ends else ""
                print(f"  {name:<8} {found['mean']:>10.3f}{band}  most {found['max']:.3f}")
    print(json.dumps({"policy": policy, "episodes": episodes, "seeds": lines}))
