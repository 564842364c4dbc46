"""Command lines that are printed for the user: each works when it is pasted into a shell.

An argument is read twice: by the shell, and by Hydra if it is an option of `sndjax run`. So a value
is quoted twice where it holds special characters.
"""

import os
import re
import shlex
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from ..system.subprocesses import PACKAGE
from .schema import Config

PROGRAM = "sndjax"
SWEEP_DIR = "hydra.sweep.dir"  # the option that names the directory of a sweep
# What Hydra reads as a text without quotes; a number or another value could not begin like this.
PLAIN = re.compile(r"(\.{0,2}/)?[A-Za-z_][A-Za-z0-9_./:-]*", re.ASCII)
OTHER_VALUES = re.compile(r"null|true|false|nan|inf", re.IGNORECASE)


def option_text(key: str, value: object) -> str:
    """Return key=value so that Hydra reads exactly this text as the value.

    >>> print(option_text("resume", "runs/mine"), option_text("resume", "my runs/a=b,c"))
    resume=runs/mine resume="my runs/a=b,c"
    """
    text = str(value)
    if PLAIN.fullmatch(text) and not OTHER_VALUES.fullmatch(text):
        return f"{key}={text}"
    quote = "'" if '"' in text and "'" not in text else '"'
    # Backslashes count as escapes only before a quote, so these are doubled.
    inside = re.sub(rf"(\\*){quote}", rf"\1\1\\{quote}", text)
    last = "\\" * (len(inside) - len(inside.rstrip("\\")))
    return f"{key}={quote}{inside}{last}{quote}"


def shell_text(argument: str) -> str:
    """Quote an argument for a shell, on one line.

    >>> print(shell_text("seed=1"), shell_text("a b"), shell_text("two\\nlines"))
    seed=1 'a b' $'two\\nlines'
    """
    if argument.isprintable():
        return shlex.quote(argument)
    parts = []
    for character in argument:
        if character in "\\'":
            parts.append(f"\\{character}")
        elif character.isprintable():
            parts.append(character)
        elif character == "\n":
            parts.append("\\n")
        else:
            parts += [f"\\x{byte:02x}" for byte in os.fsencode(character)]
    return f"$'{''.join(parts)}'"


def program() -> list[str]:
    """Return the words that start this program from a shell: `sndjax` where the shell finds it."""
    script, found = Path(sys.executable).parent / PROGRAM, shutil.which(PROGRAM)
    if not script.is_file():
        return [PROGRAM] if found else [sys.executable, "-m", f"{PACKAGE}.cli"]
    if found and Path(found).samefile(script):
        return [PROGRAM]
    here = Path.cwd()
    return [str(script.relative_to(here) if script.is_relative_to(here) else script)]


def command_text(*arguments: str) -> str:
    """Return the command line `sndjax ARGUMENTS`, quoted for a shell."""
    return " ".join(shell_text(word) for word in (*program(), *arguments))


def path_text(path: Path) -> str:
    """Return a path as an argument that no command takes for an option.

    >>> print(path_text(Path("runs/a=b")), path_text(Path("a=b")), path_text(Path("-h")))
    runs/a=b ./a=b ./-h
    """
    text = str(path)
    taken = text.startswith("-") or "=" in text.partition("/")[0]
    return f"./{text}" if taken else text


def code_options(config: Config) -> list[str]:
    """Return the options that a command line must repeat, because they name the user's code."""
    found = []
    if config.algo.module is not None:
        found.append(option_text("algo.module", config.algo.module))
    if config.env.suite in ("gymnasium", "jax") and ":" in config.env.id:
        found.append(option_text("env.id", config.env.id))
    return found


def resume_command(path: Path, config: Config) -> str:
    """Return the command line that resumes the run in a directory.

    Args:
      path: the run directory.
      config: the configuration of the run.
    """
    where = "./auto" if str(path) == "auto" else path  # resume=auto has another meaning
    return command_text(option_text("resume", where), *code_options(config))


def replay_command(dump: Path, config: Config) -> str:
    """Return the command line that repeats the update of a dump.

    Args:
      dump: the directory of the dump.
      config: the configuration of the run.
    """
    return command_text("replay", path_text(dump), *code_options(config))


def sweep_command(arguments: Sequence[str], directory: Path) -> str:
    """Return the command line that resumes the sweep in a directory.

    Args:
      arguments: the arguments that the sweep was started with.
      directory: the directory of the sweep.
    """
    own = [one for one in arguments if one.partition("=")[0].lstrip("+") != SWEEP_DIR]
    return command_text(*own, option_text(SWEEP_DIR, directory))
