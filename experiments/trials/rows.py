"""Rows of the trial: a method on a task, tuned, then run on seeds that were not looked at."""

import json
import platform
import re
import time
from pathlib import Path
from typing import Any

import numpy as np

from ..config.command_text import shell_text
from ..system.files import write_atomically
from ..system.versions import versions
from .population import Curve
from .protocol import Method, Protocol, Task
from .tuning import Report, Setting, run_arguments, score_curve, train_settings, tune

POINTS = 20  # of a curve


def bin_curve(curve: Curve) -> dict[str, list[list[float]]]:
    """Return a population's curves at evenly spaced points, a list for every agent.

    Args:
      curve: of the whole training: episodes are summed between points, the others are read there.
    """
    iterations = curve.episodes.shape[1]
    edges = np.linspace(0, iterations, min(POINTS, iterations) + 1).round().astype(int)
    sums = lambda x: np.add.reduceat(x, edges[:-1], axis=1)
    at_ends = lambda x: x[:, edges[1:] - 1]
    binned = {
        "episodes": sums(curve.episodes).astype(int),
        "solved": sums(curve.solved).astype(int),
        "coverage": at_ends(curve.coverage).astype(int),
        "progress": at_ends(curve.progress).astype(float).round(4),
    }
    return {name: values.tolist() for name, values in binned.items()}


def run_row(
    protocol: Protocol,
    task: Task,
    method: Method,
    setting: Setting,
    seeds: list[int],
    report: Report = lambda agents: None,
) -> dict[str, Any]:
    """Run a row on seeds, and return its results.

    Args:
      protocol: of the trial.
      task: of the row.
      method: of the row.
      setting: of the method.
      seeds: of the agents.
      report: called after each program.
    """
    begun, found_versions = time.monotonic(), versions()
    pairs = [(setting, seed) for seed in seeds]
    curve = train_settings(protocol, task, method, pairs, report)
    scores = score_curve(curve)
    return {
        "task": task.name,
        "method": method.name,
        "numbers": setting.numbers,
        "choices": setting.choices,
        "seeds": seeds,
        "solved": [round(float(x), 4) for x in scores.solved],
        "coverage": [int(x) for x in scores.coverage],
        "progress": [round(float(x), 4) for x in scores.progress],
        "finite": [bool(own.all()) for own in curve.finite],
        "curve": bin_curve(curve),
        "seconds": round(time.monotonic() - begun, 1),
        "steps": task.steps,
        "command": run_command(protocol, task, method, setting, seeds[0]),
        "versions": found_versions | {"machine": platform.machine()},
    }


def run_command(protocol: Protocol, task: Task, method: Method, setting: Setting, seed: int) -> str:
    """Return the command of an ordinary run with the settings of a row, and one of its seeds.

    Its numbers are constants of its program and it trains one agent, so that it is rounded
    otherwise and becomes another run: `sndjax trial repeat=` repeats a row's own.

    Args:
      protocol: of the trial.
      task: of the row.
      method: of the row.
      setting: of the method.
      seed: of the agent.
    """
    numbers = [f"{name}={value!r}" for name, value in setting.numbers.items()]
    common = run_arguments(protocol, task, method, setting.choices, 1)
    arguments = [given for given in common if given.partition("=")[0] not in setting.numbers]
    return " ".join(["sndjax", *map(shell_text, [*arguments, *numbers, f"seed={seed}"])])


def row_path(out: Path, stage: str, task: Task, method: Method) -> Path:
    """Return the file of a row.

    Args:
      out: the directory of the trial's results.
      stage: "tuning", "rows" or "causes".
      task: of the row.
      method: of the row.
    """
    return out / stage / task.name / f"{method.name}.json"


def write_json(path: Path, found: dict[str, Any]) -> None:
    """Write a JSON file with one line for each key.

    Args:
      path: the file; its directory is made.
      found: the results.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    body = ",\n".join(f"{json.dumps(key)}: {json.dumps(value)}" for key, value in found.items())
    write_atomically(path, f"{{\n{body}\n}}\n")


def tuned_setting(
    protocol: Protocol, task: Task, method: Method, out: Path, report: Report
) -> Setting:
    """Return the setting of a row: from its file, else by the search, whose file is written.

    Args:
      protocol: of the trial.
      task: of the row.
      method: of the row.
      out: the directory of the trial's results.
      report: called after each program.
    """
    path = row_path(out, "tuning", task, method)
    if not path.exists():
        begun, found_versions = time.monotonic(), versions()
        tuned = tune(protocol, task, method, report)
        found = {
            "task": task.name,
            "method": method.name,
            "numbers": tuned.setting.numbers,
            "choices": tuned.setting.choices,
            "seeds": protocol.tuning_seeds,
            "tried": tuned.tried,
            "seconds": round(time.monotonic() - begun, 1),
            "steps": task.steps,
            "versions": found_versions | {"machine": platform.machine()},
        }
        write_json(path, found)
    found = json.loads(path.read_text())
    return Setting(found["numbers"], found["choices"])


class AgentCount:
    """How many agents of a row were trained, as lines that the launcher reads."""

    def __init__(self, total: int):
        """Print that none was.

        Args:
          total: the number of agents.
        """
        self.done, self.total = 0, total
        self.add(0)

    def add(self, agents: int) -> None:
        """Add agents, and print the line."""
        self.done += agents
        print(f"{self.done} of {self.total} agents", flush=True)


def read_count(text: str) -> tuple[int, int]:
    """Return the last count of agents that a row printed, and of how many; at first 0 of 1.

    >>> read_count("a warning\\n4 of 80 agents\\n8 of 80 agents\\n")
    (8, 80)
    """
    found = re.findall(r"^(\d+) of (\d+) agents$", text, re.MULTILINE)
    return (int(found[-1][0]), int(found[-1][1])) if found else (0, 1)


def complete_row(protocol: Protocol, task: Task, method: Method, out: Path) -> None:
    """Tune and run a row, unless its files are there.

    Args:
      protocol: of the trial.
      task: of the row.
      method: of the row.
      out: the directory of the trial's results.
    """
    path = row_path(out, "rows", task, method)
    if path.exists():
        return
    begun = row_path(out, "tuning", task, method).exists()
    count = AgentCount(len(protocol.seeds) if begun else protocol.agents)
    setting = tuned_setting(protocol, task, method, out, count.add)
    write_json(path, run_row(protocol, task, method, setting, protocol.seeds, count.add))
