"""python -m experiments.run env=Venture algo=snd_std: one run from one command.

Only the configuration is read before anything heavy is imported, so that bad input is
refused in a moment.
"""

import os
import sys
from contextlib import suppress

from experiments.config import help_text, load
from experiments.directory import Directory, Elsewhere
from experiments.interrupts import Interrupted, Interrupts
from experiments.options import Config, ConfigError
from experiments.process import before_jax
from experiments.stored import CONFIG


def refuse(error: object, status: int = 2) -> int:
    """Say in one line what was wrong."""
    print(f"sndjax: {' '.join(str(error).split())}", file=sys.stderr)
    return status


def how_to_go_on(directory: Directory | Elsewhere | None) -> str:
    """The option that goes on with what stands in the directory, if anything does."""
    path = directory.shared if directory else None
    return f"; go on with resume={path}" if path and (path / CONFIG).exists() else ""


def console() -> None:
    """The `sndjax` script."""
    try:
        status = main()
        sys.stdout.flush()
    except BrokenPipeError:  # nobody reads any more
        status = 1
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    sys.stderr.flush()
    if status > 128 and "experiments.training" in sys.modules:
        os._exit(status)  # an update that was broken off may have minutes to go: do not wait
    sys.exit(status)


def main(arguments: list[str] | None = None) -> int:
    """The command; returns its exit status.

    0 done; 1 stopped by a full disk or by a number that is not finite; 2 bad input; 130 and 143
    stopped by SIGINT and SIGTERM.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if any(argument in ("-h", "--help", "help") for argument in arguments):
        print(help_text())
        return 0
    if set(arguments) & {"-m", "--multirun"}:
        from experiments.sweep import multirun

        try:
            return multirun(arguments)
        except ConfigError as error:
            return refuse(error)
    with Interrupts() as interrupts:
        return run(arguments, interrupts)


def place(config: Config) -> Directory | Elsewhere:
    """Where this process writes; of several processes of a run the first has the directory.

    Raises:
      ConfigError: it cannot be written to; all processes are told.
    """
    if not config.distributed:
        return Directory(config)
    if config.run_dir is None:
        raise ConfigError("distributed=true needs run_dir=DIRECTORY, one that all hosts see")
    before_jax()
    import jax

    from experiments.devices import agree, join_hosts

    join_hosts()
    leads, refused = jax.process_index() == 0, None
    try:
        found = Directory(config) if leads else Elsewhere(config)
    except ConfigError as error:
        refused = error
    if refused is None:
        agree(0, "were refused")
    else:
        with suppress(ConfigError):
            agree(1, "were refused")
        raise refused
    if not leads:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # one display for all
    return found


def run(arguments: list[str], interrupts: Interrupts) -> int:
    """The run that the arguments ask for; its exit status."""
    directory: Directory | Elsewhere | None = None
    try:
        config = load(arguments)
        directory = place(config)
        before_jax()
        from experiments.training import train

        train(config, directory, interrupts)
    except ConfigError as error:
        if directory is not None:
            directory.abandon()
        return refuse(error)
    except FloatingPointError as error:  # it says how to see why
        return refuse(error, 1)
    except OSError as error:
        return refuse(f"cannot write the run: {error}{how_to_go_on(directory)}", 1)
    except Interrupted as stopped:
        return refuse(f"interrupted{how_to_go_on(directory)}", stopped.status)
    finally:
        if directory is not None:
            directory.close()
    return 0


if __name__ == "__main__":
    console()
