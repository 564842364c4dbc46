"""Repeat an update that produced NaN or Inf: sndjax replay <run>/wrong-<iteration>

Reads the dump that a run writes when a number is not finite: the configuration, the state before
the update and its batch. Prints which of these numbers were not finite already, runs the same
update again, and names the operation that produces the first NaN.

If the run uses a custom module or task (Python code), repeat algo.module=... or env.id=...
"""

from dataclasses import dataclass
from pathlib import Path

from .config.help import tool_help
from .config.tool_options import asks_for_help, exit_status
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The options of the command: none; it takes the options of a run."""


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    if asks_for_help(arguments) or not arguments:
        print(tool_help(str(__doc__), Options))
        return 0 if arguments else 2

    def replay() -> None:
        from .analysis.update_replay import dump_config, load_dump, replay_update

        dump = Path(arguments[0])
        config = dump_config(dump, arguments[1:])
        replay_update(*load_dump(dump, config))

    return exit_status(replay)


if __name__ == "__main__":
    run_script(main)
