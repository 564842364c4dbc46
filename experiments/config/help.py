"""The text that `--help` prints: options with their defaults, ranges and meanings."""

from collections.abc import Iterable
from dataclasses import MISSING, Field, fields
from textwrap import dedent
from typing import Any

from .validation import config_options

HELP = ("-h", "--help", "help")  # the words that ask for help


def default_of(entry: Field[Any]) -> Any:
    """Return the default of an option."""
    if entry.default is not MISSING:
        return entry.default
    assert entry.default_factory is not MISSING
    return entry.default_factory()


def option_lines(named: Iterable[tuple[str, Field[Any]]], width: int) -> list[str]:
    """Return one line per option: its name and default, its meaning, its allowed values.

    Args:
      named: pairs of an option's name and its dataclass field.
      width: the width of the first column, in characters.
    """
    lines = []
    for name, entry in named:
        default = default_of(entry)
        shown = "" if default in (None, "???", ()) or default == {} else str(default)
        about = f"{entry.metadata['about']}{allowed(entry.metadata)}"
        lines.append(f"  {f'{name}={shown}':<{width}} {about}")
    return lines


def allowed(limits: Any) -> str:
    """Return the allowed values of an option in brackets, or "".

    >>> allowed({"choices": None, "low": 0, "above": None, "high": 1})
    ' [0 to 1]'
    >>> allowed({"choices": ("a", "b"), "low": None, "above": None, "high": None})
    ' [a | b]'
    """
    if limits["choices"]:
        return f" [{' | '.join(limits['choices'])}]"
    low, above, high = limits["low"], limits["above"], limits["high"]
    if low is not None and high is not None:
        return f" [{low} to {high}]"
    parts = [
        f"{words} {bound}"
        for words, bound in (("at least", low), ("more than", above), ("at most", high))
        if bound is not None
    ]
    return f" [{', '.join(parts)}]" if parts else ""


def run_option_lines() -> list[str]:
    """Return the help lines of every option of `sndjax run`."""
    head = "options (key=value, with their defaults; env and algo may change them)"
    return [head, *option_lines(config_options(), 34)]


def tool_help(about: str, kind: Any, takes_run_options: bool = False) -> str:
    """Return the text that `--help` of a tool prints.

    Args:
      about: the docstring of the tool.
      kind: the dataclass of its options, made by `experiments.config.schema.option`.
      takes_run_options: whether the tool also takes the options of `sndjax run`.
    """
    lines = [dedent(about).strip()]
    own = [(entry.name, entry) for entry in fields(kind)]
    if own:
        lines += ["", "options (key=value, or --key value)", *option_lines(own, 26)]
    if takes_run_options:
        lines += ["", *run_option_lines()]
    return "\n".join(lines)
