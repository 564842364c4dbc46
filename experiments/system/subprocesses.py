"""Starting Python in child processes; no other module of the laboratory does this.

A child is started by the package name that the laboratory was imported under: `experiments` in a
checkout, `sndjax_lab` where it is installed. With `-P` Python leaves the working directory out of
its search path, so that an `experiments` folder of the user is not imported by mistake.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

PACKAGE = __name__.partition(".")[0]
INSTALLED = "sndjax_lab"
ROOT = Path(__file__).resolve().parents[2]


def command_line(command: str, *arguments: str, dies_with_parent: bool = False) -> list[str]:
    """Return the command line that runs a command of `cli.py` in a child process.

    Args:
      command: the name of the command, such as "run".
      *arguments: the arguments of the command.
      dies_with_parent: send the child SIGTERM when this process ends, if `setpriv` is installed.
    """
    line = [sys.executable, "-P", "-m", f"{PACKAGE}.cli", command, *arguments]
    if dies_with_parent and shutil.which("setpriv"):
        return ["setpriv", "--pdeathsig", "TERM", *line]
    return line


def child_environment(**variables: str) -> dict[str, str]:
    """Return the environment of this process for a child, with variables added or replaced.

    If the package is not installed, the checkout is added to the child's search path.
    """
    environment = os.environ | variables
    if PACKAGE != INSTALLED:
        paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment["PYTHONPATH"] = os.pathsep.join(paths)
    return environment


def run_command_line(
    command: str, *arguments: str, captured: bool = False
) -> subprocess.CompletedProcess[str]:
    """Run a command in a child process until it ends.

    Args:
      command: the name of the command, such as "run".
      *arguments: the arguments of the command.
      captured: keep what the child prints on stdout, instead of printing it.
    """
    return subprocess.run(
        command_line(command, *arguments),
        stdout=subprocess.PIPE if captured else None,
        text=True,
        env=child_environment(),
        check=False,
    )


def run_code(code: str) -> subprocess.CompletedProcess[str]:
    """Run some Python code in a child process, and keep what it prints."""
    line = [sys.executable, "-P", "-c", code]
    return subprocess.run(line, capture_output=True, text=True, check=False)


def start_command(
    command: str,
    arguments: Sequence[str],
    *,
    output: Any = None,
    errors: Any = None,
    cwd: str | None = None,
    variables: Mapping[str, str] = {},
) -> subprocess.Popen[bytes]:
    """Start a command in a child process that ends when this process ends.

    The child has a separate session, so that Ctrl-C in a terminal reaches only this process. It
    gets SIGTERM when this process ends.

    Args:
      command: the name of the command, such as "run".
      arguments: the arguments of the command.
      output: a file for what the child prints; None: the output of this process.
      errors: a file for what it prints on stderr; None: `output`.
      cwd: the working directory of the child; None: that of this process.
      variables: further environment variables.

    Returns:
      The child process.
    """
    return subprocess.Popen(
        command_line(command, *arguments, dies_with_parent=True),
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=output if errors is None else errors,
        cwd=cwd,
        env=child_environment(**variables),
        start_new_session=True,
    )
