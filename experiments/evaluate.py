"""python -m experiments.evaluate RUN_DIR episodes=20: how well an agent plays, without training.

Prints return, score and length (and rooms, in Montezuma's Revenge) of every seed of the run, each
the mean over episodes with its 95% bootstrap interval; as its last line a JSON object.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.arguments import TRUST, command, only
from experiments.options import option
from experiments.process import before_jax


@dataclass(frozen=True)
class Options:
    """What can be chosen."""

    episodes: int = option(16, "that each seed plays, side by side", low=1, high=1024)
    policy: str = option("sampled", "how actions are taken", choices=("sampled", "greedy"))
    seed: int = option(0, "of the environments", low=0, high=2**31 - 1)
    trust: str | None = option(None, TRUST)


def figures(played: list[Any]) -> dict[str, np.ndarray]:
    """Of each episode what is reported, float64[E]."""
    found = {
        "return": np.array([episode.reward.sum(dtype=np.float64) for episode in played]),
        "score": np.array([episode.score.sum(dtype=np.float64) for episode in played]),
        "length": np.array([float(len(episode.action)) for episode in played]),
    }
    if any(episode.room.any() for episode in played):
        found["rooms"] = np.array([float(len(np.unique(episode.room))) for episode in played])
    return found


def evaluate(run: Path, options: Options) -> list[dict[str, Any]]:
    """The figures of every seed of a run.

    Raises:
      ConfigError: there is no agent to play.
    """
    from experiments.estimates import interval
    from experiments.player import load, play
    from experiments.progress import Bars

    lines = []
    with Bars() as bars:
        for player in load(run, options.trust):
            name = f"seed {player.seed}"

            def report(steps: int, ended: int, name: str = name) -> None:
                bars.to(name, ended, options.episodes, f"episodes, step {steps:,}")

            greedy = options.policy == "greedy"
            played = play(player, options.episodes, greedy, options.seed, False, report)
            line: dict[str, Any] = {"seed": player.seed, "iteration": player.iteration}
            for name, values in figures(played).items():
                line[name] = {"mean": float(values.mean()), "max": float(values.max())}
                band = interval(values)
                if band is not None:
                    line[name]["interval"] = [float(x) for x in band]
            lines.append(line)
    return lines


def work(places: list[Path], options: Options) -> None:
    """Print the figures."""
    lines = evaluate(only(places), options)
    for line in lines:
        print(f"seed {line['seed']}, iteration {line['iteration']}, {options.policy}")
        for name in ("return", "score", "length", "rooms"):
            if name in line:
                found = line[name]
                ends = found.get("interval")
                band = f"  95% {ends[0]:.3f} to {ends[1]:.3f}" if ends else ""
                print(f"  {name:<8} {found['mean']:>10.3f}{band}  most {found['max']:.3f}")
    print(json.dumps({"policy": options.policy, "episodes": options.episodes, "seeds": lines}))


def main(arguments: list[str]) -> int:
    """The command."""
    return command(str(__doc__), Options, work, arguments)


if __name__ == "__main__":
    before_jax()
    sys.exit(main(sys.argv[1:]))
