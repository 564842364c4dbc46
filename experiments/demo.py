"""Train PPO and SND-VIC on MountainCar, and draw their learning curves: sndjax demo

Shows in seconds what a novelty bonus changes: the reward is only at the goal. Trains three seeds of
each algorithm, and draws the learning curves in one picture.
"""

import secrets
import time
from dataclasses import dataclass
from pathlib import Path

from .config.command_text import command_text, option_text
from .config.option import option
from .config.tool_options import run_command
from .system.process import run_script
from .system.subprocesses import run_command_line

ALGORITHMS = ("ppo", "snd_vic")


@dataclass(frozen=True)
class Options:
    """The options of the command."""

    seeds: int = option(3, "agents of each algorithm", low=1)
    steps: int = option(1_000_000, "that each agent takes", low=1)


def demo(paths: list[Path], options: Options) -> None:
    """Train both algorithms, and draw their learning curves in one picture.

    Raises:
      SystemExit: a run failed; with the exit status of the run.
    """
    root = Path("runs") / "demo" / f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(2)}"
    runs = {algo: root / algo for algo in ALGORITHMS}
    print("MountainCar, reward 1 at the goal and 0 elsewhere: does it ever get there?")
    for algo, run in runs.items():
        arguments = ["env=MountainCar", f"algo={algo}", f"num_seeds={options.seeds}"]
        arguments += [f"total_steps={options.steps}", option_text("run_dir", run)]
        print(f"\n$ {command_text(*arguments)}", flush=True)
        if status := run_command_line("run", *arguments).returncode:
            raise SystemExit(status if status > 0 else 128 - status)  # the run printed the reason
    from .reporting.learning_curves import draw_curves
    from .storage.read_runs import find_runs, group_runs, read_summary

    groups = group_runs(find_runs([root])[0])
    title = "MountainCar, reward only at the goal"
    picture = draw_curves(groups, "last100", title, root, "curves")
    print()
    for algo, run in runs.items():
        shares = ", ".join(f"{seed['last100_ext_return']:.0%}" for seed in read_summary(run))
        print(f"{algo:<8} last 100 episodes that reach the goal, by seed: {shares}")
    if picture is not None:
        print(f"\npicture: {picture.resolve()}")


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, demo, arguments, paths="none")


if __name__ == "__main__":
    run_script(main)
