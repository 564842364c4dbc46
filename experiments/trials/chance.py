"""How often random actions solve a task of the trial."""

import json
import math
from pathlib import Path

from ..benchmarks.random_agent import play_random
from ..config.compose import load_config
from .protocol import Protocol, Task
from .rows import write_json

FILE = "chance.json"
STEPS, ENVS = 10_000_000, 1000


def read_chance(out: Path) -> dict[str, list[int]]:
    """Return the stored ended and solved episodes of random actions by task; {} if there are none.

    Args:
      out: the directory of the trial's results.
    """
    path = out / FILE
    return json.loads(path.read_text()) if path.exists() else {}


def measure_chance(protocol: Protocol, out: Path) -> None:
    """Store the ended and the solved episodes of random actions for every task.

    Args:
      protocol: of the trial.
      out: the directory of its results; what its file holds is not measured again.
    """
    found = read_chance(out)
    for task in protocol.tasks.values():
        if task.name not in found:
            found[task.name] = play_task(task)
            write_json(out / FILE, found)


def play_task(task: Task) -> list[int]:
    """Play a task at random, and return how many episodes ended and how many were solved.

    Args:
      task: of the trial.
    """
    sizes = [f"total_steps={STEPS}", f"num_envs={ENVS}"]
    returns, _, _ = play_random(load_config([*task.arguments, "algo=ppo", *sizes]), 1.0)
    return [len(returns), int((returns > 0).sum())]


def format_chance(ended: int, solved: int) -> str:
    """Return the share of solved episodes, or its upper bound where there were none.

    With no success in n episodes the 95% upper bound is 1 - 0.05 ** (1 / n).

    >>> format_chance(1000, 20), format_chance(1000, 0)
    ('2.0e-02', '< 3.0e-03')
    """
    if solved:
        return f"{solved / ended:.1e}"
    return f"< {-math.expm1(math.log(0.05) / max(ended, 1)):.1e}"
