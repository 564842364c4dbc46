"""Print the state of each job of a sweep: sndjax sweep status DIR

A sweep is started by `sndjax -m env=A,B algo=C,D seed=0,9`. All jobs are checked before the first
starts. Hydra's launcher runs the valid jobs that are not finished, each in a separate process.
"""

from dataclasses import dataclass
from pathlib import Path

from .config.tool_options import run_command
from .system.errors import ConfigError
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The options of the command: none."""


def sweep(paths: list[Path], options: Options) -> None:
    """Print the table of a sweep's jobs.

    Raises:
      ConfigError: the command line is not `status DIR`, or the directory holds no sweep.
    """
    if len(paths) != 2 or str(paths[0]) != "status":
        raise ConfigError(f"'{' '.join(map(str, paths))}': write sndjax sweep status DIR")
    from .sweeps.job_status import job_statuses
    from .sweeps.live_table import status_table

    print(status_table(job_statuses(paths[1])))


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, sweep, arguments)


if __name__ == "__main__":
    run_script(main)
