"""How well an agent plays: return, score, length and rooms over whole episodes."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from ..reporting.seed_statistics import bootstrap_interval
from ..system.display import ProgressBars
from .players import PlayedEpisode, load_players, play_episodes


def episode_metrics(played: list[PlayedEpisode]) -> dict[str, np.ndarray]:
    """Return what is reported of each episode, float64[E]."""
    found = {
        "return": np.array([episode.reward.sum(dtype=np.float64) for episode in played]),
        "score": np.array([episode.score.sum(dtype=np.float64) for episode in played]),
        "length": np.array([float(len(episode.action)) for episode in played]),
    }
    if any(episode.room.any() for episode in played):
        found["rooms"] = np.array([float(len(np.unique(episode.room))) for episode in played])
    return found


def evaluate_run(
    run: Path, episodes: int, greedy: bool, seed: int, trust: str | None = None
) -> list[dict[str, Any]]:
    """Play with every seed of a run, and return the figures of each.

    Args:
      run: its directory.
      episodes: that each seed plays, side by side.
      greedy: take the likeliest action instead of drawing one.
      seed: of the environments.
      trust: the code that the run's configuration names, see `load_players`.

    Raises:
      ConfigError: there is no agent to play.
    """
    lines = []
    with ProgressBars() as bars:
        for player in load_players(run, trust):
            name = f"seed {player.seed}"

            def report(steps: int, ended: int, name: str = name) -> None:
                bars.update(name, ended, episodes, f"episodes, step {steps:,}")

            played = play_episodes(player, episodes, greedy, seed, False, report)
            line: dict[str, Any] = {"seed": player.seed, "iteration": player.iteration}
            for name, values in episode_metrics(played).items():
                line[name] = {"mean": float(values.mean()), "max": float(values.max())}
                band = bootstrap_interval(values)
                if band is not None:
                    line[name]["interval"] = [float(x) for x in band]
            lines.append(line)
    return lines


def print_metrics(lines: list[dict[str, Any]], policy: str, episodes: int) -> None:
    """Print the figures of every seed, and as the last line a JSON object.

    Args:
      lines: of `evaluate_run`.
      policy: how actions were taken.
      episodes: that each seed played.
    """
    for line in lines:
        print(f"seed {line['seed']}, iteration {line['iteration']}, {policy}")
        for name in ("return", "score", "length", "rooms"):
            if name in line:
                found = line[name]
                ends = found.get("interval")
                band = f"  95% {ends[0]:.3f} to {ends[1]:.3f}" if ends else ""
                print(f"  {name:<8} {found['mean']:>10.3f}{band}  most {found['max']:.3f}")
    print(json.dumps({"policy": policy, "episodes": episodes, "seeds": lines}))
