"""The first seeds of a row once more, beside the results that are stored."""

import json
from pathlib import Path

from ..system.errors import ConfigError
from .protocol import Method, Protocol, Task
from .rows import AgentCount, row_path, run_row
from .tuning import Setting


def repeat_row(protocol: Protocol, task: Task, method: Method, out: Path, seeds: int) -> None:
    """Run the first seeds of a row again, and print them beside the stored results.

    On the same versions and the same kind of CPU the seeds repeat. What rounds otherwise (other
    versions, another CPU, one agent in a program in place of four) makes another run of the seed:
    then only the distribution is the same.

    Args:
      protocol: of the trial.
      task: of the row.
      method: of the row.
      out: the directory of the trial's results.
      seeds: how many.

    Raises:
      ConfigError: the row has no results yet, or not so many seeds.
    """
    path = row_path(out, "rows", task, method)
    if not path.exists():
        raise ConfigError(f"repeat={task.name}/{method.name}: {path} is not there yet")
    stored = json.loads(path.read_text())
    if seeds > len(stored["seeds"]):
        raise ConfigError(f"seeds={seeds}: the row has {len(stored['seeds'])}")
    setting = Setting(stored["numbers"], stored["choices"])
    print(f"{task.title}, {method.title}: {seeds} of {len(stored['seeds'])} seeds", flush=True)
    count = AgentCount(seeds)
    found = run_row(protocol, task, method, setting, stored["seeds"][:seeds], count.add)
    print("seed   solved  stored   coverage  stored")
    for i, seed in enumerate(found["seeds"]):
        solved, coverage = found["solved"][i], found["coverage"][i]
        before, places = stored["solved"][i], stored["coverage"][i]
        print(f"{seed:<6} {solved:<7.4f} {before:<8.4f} {coverage:<9} {places}")
    print(f"an ordinary run with these settings: {found['command']}")
