"""How a command of the laboratory is started in a process of its own: the one place.

A child is started by the name that the laboratory was imported under: `experiments` in a checkout,
`sndjax_lab` where it is installed. With `-P` Python leaves the working directory out of its search
path, so that no `experiments` folder of the user's is taken for ours.
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
      command: its name, such as "run".
      *arguments: what it is given.
      dies_with_parent: send the child a SIGTERM when this process ends, where the system can.
    """
    line = [sys.executable, "-P", "-m", f"{PACKAGE}.cli", command, *arguments]
    if dies_with_parent and shutil.which("setpriv"):
        return ["setpriv", "--pdeathsig", "TERM", *line]
    return line


def child_environment(**variables: str) -> dict[str, str]:
    """Return this process' environment for a child, with further variables over it.

    A checkout that is not installed is put on the child's search path.
    """
    environment = os.environ | variables
    if PACKAGE != INSTALLED:
        paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment["PYTHONPATH"] = os.pathsep.join(paths)
    return environment


def start_command(
    command: str,
    arguments: Sequence[str],
    *,
    output: Any = None,
    cwd: str | None = None,
    variables: Mapping[str, str] = {},
) -> subprocess.Popen[bytes]:
    """Start a command that outlives neither this process nor its own work.

    It is a session of its own, so that a terminal's Ctrl-C is for this process to answer, and it
    gets a SIGTERM when this process ends.

    Args:
      command: its name, such as "run".
      arguments: what it is given.
      output: a file for what it prints; None: this process' own.
      cwd: where it runs.
      variables: further environment variables.
    """
    return subprocess.Popen(
        command_line(command, *arguments, dies_with_parent=True),
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=output,
        cwd=cwd,
        env=child_environment(**variables),
        start_new_session=True,
    )
