"""Measure how well trained agents play: sndjax evaluate RUN_DIR episodes=20

Plays without training. Prints the return, score and length (in Montezuma's Revenge also the rooms)
of every seed of the run, each as the mean over episodes with its 95% bootstrap interval, and how
many episodes were complete. The last line is a JSON object.
"""

from dataclasses import dataclass
from pathlib import Path

from .config.option import option
from .config.tool_options import TRUST, run_command, single_run
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The options of the command."""

    episodes: int = option(16, "that each seed plays, side by side", low=1, high=1024)
    policy: str = option("sampled", "how actions are taken", choices=("sampled", "greedy"))
    seed: int = option(0, "of the environments", low=0, high=2**31 - 1)
    max_steps: int = option(27_000, "of an episode; one without end is cut, and said to be", low=1)
    trust: tuple[str, ...] = option((), TRUST)


def evaluate(paths: list[Path], options: Options) -> None:
    """Play the episodes, and print the metrics."""
    run = single_run(paths)
    from .evaluation.metrics import evaluate_run, print_metrics

    lines = evaluate_run(
        run,
        options.episodes,
        options.policy == "greedy",
        options.seed,
        options.trust,
        options.max_steps,
    )
    print_metrics(lines, options.policy, options.episodes)


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, evaluate, arguments)


if __name__ == "__main__":
    run_script(main)
