"""python -m experiments.run env=Venture algo=snd_std: one run from one command.

Only the configuration is read before anything heavy is imported, so that bad input is
refused in a moment.
"""

import os
import sys
import warnings

from experiments.config import help_text, load
from experiments.directory import CONFIG, Directory
from experiments.interrupts import Interrupted
from experiments.options import ConfigError
from experiments.process import before_jax


def refuse(error: object) -> int:
    """Say in one line what was wrong with the input."""
    print(f"sndjax: {' '.join(str(error).split())}", file=sys.stderr)
    return 2


def interrupted(directory: Directory | None, status: int) -> int:
    """Say how to go on."""
    path = directory.path if directory else None
    where = f"; go on with resume={path}" if path and (path / CONFIG).exists() else ""
    print(f"\nsndjax: interrupted{where}", file=sys.stderr)
    return status


def console() -> None:
    """The `sndjax` script."""
    status = main()
    sys.stdout.flush()
    sys.stderr.flush()
    if status > 128:
        os._exit(status)  # an update that was broken off may have minutes to go: do not wait
    sys.exit(status)


def main(arguments: list[str] | None = None) -> int:
    """The command; returns its exit status.

    0 done, 2 bad input, 130 and 143 stopped by SIGINT and SIGTERM.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if any(argument in ("-h", "--help", "help") for argument in arguments):
        print(help_text())
        return 0
    warnings.filterwarnings("ignore", message=".*Box (low|high)'s precision.*")
    directory = None
    try:
        config = load(arguments)
        directory = Directory(config)
        before_jax()
        from experiments.training import train

        train(config, directory)
    except ConfigError as error:
        if directory is not None:
            directory.abandon()
        return refuse(error)
    except OSError as error:
        return refuse(f"cannot write the run: {error}")
    except KeyboardInterrupt:  # before the first iteration
        return interrupted(directory, 130)
    except Interrupted as stopped:
        return interrupted(directory, stopped.status)
    finally:
        if directory is not None:
            directory.close()
    return 0


if __name__ == "__main__":
    console()
