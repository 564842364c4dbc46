"""Train one agent, or a sweep of them: sndjax env=Venture algo=snd_std.

Only the configuration is read before anything heavy is imported, so that bad input is refused in a
moment.
"""

import os
from collections.abc import Sequence
from contextlib import suppress

from .config.compose import load_config
from .config.help import run_help
from .config.saved import CONFIG
from .config.schema import Config
from .config.tool_options import asks_for_help
from .storage.run_directory import FollowerDirectory, RunDirectory
from .system.errors import ConfigError, print_error
from .system.interrupts import Interrupted, Interrupts
from .system.process import configure_xla, run_script


def resume_hint(directory: RunDirectory | FollowerDirectory | None) -> str:
    """Return how to resume what is in the directory, or "" where there is nothing to resume."""
    path = directory.shared if directory else None
    return f"; to resume: resume={path}" if path and (path / CONFIG).exists() else ""


def main(arguments: Sequence[str]) -> int:
    """Train what the arguments ask for, and return the exit status.

    0 done; 1 stopped by a full disk or by a number that is not finite; 2 bad input; 130 and 143
    stopped by SIGINT and SIGTERM.
    """
    if asks_for_help(arguments) or list(arguments[:1]) == ["help"]:
        print(run_help())
        return 0
    if set(arguments) & {"-m", "--multirun"}:
        from .sweeps.multirun import multirun

        try:
            return multirun(arguments)
        except ConfigError as error:
            return print_error(error)
    with Interrupts() as interrupts:
        return train(list(arguments), interrupts)


def open_run_directory(config: Config) -> RunDirectory | FollowerDirectory:
    """Return the directory that this process writes to; the first process has the run's.

    Raises:
      ConfigError: it cannot be written to; all processes get the error.
    """
    if not config.distributed:
        return RunDirectory(config)
    if config.run_dir is None:
        raise ConfigError("distributed=true needs run_dir=DIRECTORY, one that all hosts see")
    configure_xla()
    import jax

    from .training.placement import assert_equal_on_hosts, join_hosts

    join_hosts()
    leads, refused = jax.process_index() == 0, None
    try:
        found = RunDirectory(config) if leads else FollowerDirectory(config)
    except ConfigError as error:
        refused = error
    if refused is None:
        assert_equal_on_hosts(0, "were refused")
    else:
        with suppress(ConfigError):
            assert_equal_on_hosts(1, "were refused")
        raise refused
    if not leads:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # one display for all
    return found


def train(arguments: list[str], interrupts: Interrupts) -> int:
    """Train the run that the arguments ask for, and return its exit status."""
    directory: RunDirectory | FollowerDirectory | None = None
    try:
        config = load_config(arguments)
        directory = open_run_directory(config)
        configure_xla()
        from .training.trainer import train

        train(config, directory, interrupts)
    except ConfigError as error:
        if directory is not None:
            directory.discard()
        return print_error(error)
    except FloatingPointError as error:  # it says how to see why
        return print_error(error, 1)
    except OSError as error:
        return print_error(f"cannot write the run: {error}{resume_hint(directory)}", 1)
    except Interrupted as stopped:
        return print_error(f"interrupted{resume_hint(directory)}", stopped.status)
    finally:
        if directory is not None:
            directory.close()
    return 0


if __name__ == "__main__":
    run_script(main)
