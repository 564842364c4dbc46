"""Train one agent, or a sweep of them: sndjax env=Venture algo=snd_std.

The configuration is read and checked before the slow imports (such as jax), so that bad input is
refused at once.
"""

import errno
import os
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from .config.command_text import resume_command
from .config.compose import load_config
from .config.explain import describe_config
from .config.help import HELP
from .config.key_value import to_key_value
from .config.option_help import run_help
from .config.saved import CONFIG
from .config.schema import Config
from .config.tool_options import asks_for_help
from .storage.run_directory import FollowerDirectory, RunDirectory
from .system.errors import ConfigError, NonFiniteError, TaskError, WriteError, print_error
from .system.interrupts import Interrupted, Interrupts
from .system.jax_settings import jax_problem
from .system.process import configure_xla, run_script
from .system.versions import version_line

# What a disk answers that is full, broken or not to be written.
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)


def resume_hint(directory: RunDirectory | FollowerDirectory | None, config: Config | None) -> str:
    """Return a hint how to resume the run in a directory, or "" if there is no run."""
    if directory is None or config is None or not (directory.shared / CONFIG).exists():
        return ""
    return f"; to resume: {resume_command(directory.shared, config)}"


def left_behind(directory: RunDirectory | FollowerDirectory | None, config: Config | None) -> str:
    """Return a hint how to resume a run that an error stopped; remove a run that never began."""
    if directory is not None:
        directory.discard()
    return resume_hint(directory, config)


def concerns_files(error: OSError, directory: RunDirectory | FollowerDirectory | None) -> bool:
    """Return True if an error is one of writing the run: of a full disk, or of one of its files."""
    if error.errno in FULL or isinstance(error, WriteError):
        return True
    named = [Path(str(name)) for name in (error.filename, error.filename2) if name is not None]
    if directory is None:
        return bool(named)
    own = (directory.path.resolve(), directory.shared.resolve())
    return any(path.resolve().is_relative_to(place) for path in named for place in own)


def main(arguments: Sequence[str]) -> int:
    """Train the run or the sweep of a command line, and return the exit status.

    The status is 0 for done; 1 for a run that a full disk, a number that is not finite, the
    environment or another error stopped; 2 for bad input; 130 and 143 for a run that SIGINT and
    SIGTERM stopped.
    """
    arguments = to_key_value(arguments)
    if asks_for_help(arguments) or arguments[:1] == ["help"]:
        return print_text(lambda: run_help([a for a in arguments if a not in HELP]))
    if "--version" in arguments:
        print(version_line())
        return 0
    if "--cfg" in arguments:
        return print_text(lambda: describe_config([a for a in arguments if a != "--cfg"]))
    if set(arguments) & {"-m", "--multirun"}:
        from .sweeps.multirun import multirun

        try:
            return multirun(arguments)
        except ConfigError as error:
            return print_error(error)
    with Interrupts() as interrupts:
        return train(list(arguments), interrupts)


def print_text(make: Callable[[], str]) -> int:
    """Print the text that a function returns, or its ConfigError; return the exit status."""
    try:
        print(make())
    except ConfigError as error:
        return print_error(error)
    return 0


def open_run_directory(config: Config) -> RunDirectory | FollowerDirectory:
    """Return the run directory in the first process, a `FollowerDirectory` in the others.

    Raises:
      ConfigError: the directory cannot be written to (all processes get the error), or a
        distributed run has no run_dir.
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
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # only the first process prints
    return found


def train(arguments: list[str], interrupts: Interrupts) -> int:
    """Train the run of a command line, and return its exit status."""
    directory: RunDirectory | FollowerDirectory | None = None
    config: Config | None = None
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
    except NonFiniteError as error:  # the message says how to find the cause
        return print_error(error, 1)
    except TaskError as error:
        return print_error(f"{error}{left_behind(directory, config)}", 1)
    except Interrupted as stopped:
        return print_error(f"interrupted{resume_hint(directory, config)}", stopped.status)
    except (Exception, SystemExit, KeyboardInterrupt) as error:
        problem, hint = jax_problem(error), left_behind(directory, config)
        if problem is not None:
            return print_error(problem)
        if isinstance(error, OSError) and concerns_files(error, directory):
            return print_error(f"cannot write the run: {error}{hint}", 1)
        traceback.print_exc()  # of ours, or of a module of the user's own
        return print_error(f"stopped by {type(error).__name__}: {error}{hint}", 1)
    finally:
        if directory is not None:
            directory.close()
    return 0


if __name__ == "__main__":
    run_script(main)
