"""Search for a long path through Montezuma's Revenge: sndjax trajectory [FILE]

The search needs no agent. It is the first phase of Go-Explore (Ecoffet et al., 2021): an archive of
cells, each with an emulator state that can be restored, and random actions from these states.
Writes the list of actions, by default to experiments/data/montezuma.json; the frames can be made
again from it. Takes up to ten minutes. A seed gives the same path on every machine that is fast
enough to search equally far in this time.
"""

import json
import os
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path

from .config.option import option
from .config.tool_options import run_command
from .system.errors import ConfigError
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The options of the command."""

    seconds: int = option(480, "the longest time of the search", low=1)


def search(paths: list[Path], options: Options) -> None:
    """Search on every core, and write the path through the most rooms.

    Raises:
      ConfigError: several files are given, ale-py is missing, or the file cannot be written.
    """
    if len(paths) > 1:
        raise ConfigError("give one file, or none")
    if find_spec("ale_py") is None:
        raise ConfigError("the search needs ale-py: pip install '.[search]'")
    from .analysis.go_explore import search_path
    from .analysis.montezuma_path import ACTION_LETTERS, DATA, play_actions, trajectory_digest

    path = paths[0] if paths else DATA
    if not os.access(path.parent, os.W_OK):
        raise ConfigError(f"cannot write to {path.parent}")
    deadline, cores = time.time() + options.seconds, os.cpu_count() or 1
    with ProcessPoolExecutor(cores, get_context("spawn")) as pool:
        found = list(pool.map(search_path, range(cores), cores * [deadline]))
    rooms, actions = max(found)
    trajectory = play_actions(actions)
    seen = list(dict.fromkeys(trajectory.room.tolist()))
    print(f"{len(trajectory.frames):,} states through {rooms} rooms and more: {seen}")
    content = {
        "actions": "".join(ACTION_LETTERS[action] for action in actions),
        "sha256": trajectory_digest(trajectory),
        "rooms": seen,
        "envpool": version("envpool"),
        "ale_py": version("ale-py"),
    }
    path.write_text(json.dumps(content, indent=1) + "\n")


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, search, arguments, paths="optional")


if __name__ == "__main__":
    run_script(main)
