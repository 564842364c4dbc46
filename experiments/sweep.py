"""Say how far each job of a sweep is: sndjax sweep status DIR

A sweep is started by `sndjax -m env=A,B algo=C,D seed=0,9`: its jobs are checked before the first
starts; those that can run and are not finished are handed to Hydra's launcher, each a process of
its own.
"""

from pathlib import Path

from .config.tool_options import asks_for_help, exit_status
from .system.errors import print_error
from .system.process import run_script


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    if asks_for_help(arguments) or not arguments:
        print(str(__doc__).strip())
        return 0 if arguments else 2
    if len(arguments) != 2 or arguments[0] != "status":
        return print_error(f"'{' '.join(arguments)}': write sndjax sweep status DIR")

    def status() -> None:
        from .sweeps.job_status import job_statuses
        from .sweeps.live_table import status_table

        print(status_table(job_statuses(Path(arguments[1]))))

    return exit_status(status)


if __name__ == "__main__":
    run_script(main)
