"""Errors that a command prints as one line."""

import sys
import traceback


class ConfigError(ValueError):
    """An error in the input; its text is one line that says what to do."""


class TaskError(Exception):
    """An error that the code of the environment raised, named by its task, type and place."""

    def __init__(self, task: str, error: BaseException):
        text, last = one_line(error), traceback.extract_tb(error.__traceback__)[-1:]
        where = "".join(f" ({frame.filename}, line {frame.lineno})" for frame in last)
        what = f"{type(error).__name__}{': ' if text else ''}{text}"
        super().__init__(f"the environment {task} failed: {what}{where}")


class WriteError(OSError):
    """An error of writing a run that was caught elsewhere and is raised again with more to say."""


class NonFiniteError(Exception):
    """A number of a run that is not finite; its text names the number and the dump."""


def one_line(error: object) -> str:
    """Return the text of an error on one line; spaces inside a line are kept, as in a path.

    >>> one_line("two\\n  lines: 'a  b'")
    "two lines: 'a  b'"
    """
    return " ".join(line.strip() for line in str(error).splitlines() if line.strip())


def print_error(error: object, status: int = 2) -> int:
    """Print an error as one line on stderr, and return the exit status."""
    print(f"sndjax: {one_line(error)}", file=sys.stderr)
    return status
