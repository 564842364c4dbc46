"""Errors that a command prints as one line."""

import sys


class ConfigError(ValueError):
    """An error in the input; its text is one line that says what to do."""


def print_error(error: object, status: int = 2) -> int:
    """Print an error as one line on stderr, and return the exit status."""
    print(f"sndjax: {' '.join(str(error).split())}", file=sys.stderr)
    return status
