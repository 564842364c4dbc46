"""The command lines of the tools: places, and options as `key=value` or `--key value`."""

from collections.abc import Callable, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, TypeVar

from experiments.options import ConfigError
from experiments.run import refuse
from experiments.validate import check, unknown

Options = TypeVar("Options")
TRUST = "the code that the run's configuration names (its algo.module or env.id), if any"


def default_of(entry: Any) -> Any:
    """The default of an option."""
    return entry.default if entry.default is not MISSING else entry.default_factory()


def usage(about: str, kind: Any) -> str:
    """What `--help` prints: the tool's own words and its options."""
    lines = [about.strip(), "", "options (key=value, or --key value)"]
    for entry in fields(kind):
        default = default_of(entry)
        shown = "" if default is None else str(default)
        values = entry.metadata["choices"]
        more = f" [{' | '.join(values)}]" if values else ""
        lines.append(f"  {entry.name + '=' + shown:<26} {entry.metadata['about']}{more}")
    return "\n".join(lines)


def converted(name: str, text: str, default: Any) -> Any:
    """A value of the kind that the default has."""
    try:
        if isinstance(default, bool):
            return {"true": True, "false": False}[text.lower()]
        return (
            text
            if default is None
            else type(default)(text.replace("_", "") if type(default) in (int, float) else text)
        )
    except (ValueError, KeyError):
        kind = {bool: "true or false", int: "a whole number", float: "a number"}[type(default)]
        raise ConfigError(f"{name}={text}: must be {kind}") from None


def read(arguments: Sequence[str], kind: type[Options]) -> tuple[list[Path], Options]:
    """The places and the options that a command line gives.

    Args:
      arguments: of the process, without its name.
      kind: a dataclass whose fields are made by `experiments.options.option`.

    Raises:
      ConfigError: an option that does not exist, is given twice, or is out of its range.

    >>> from dataclasses import dataclass
    >>> from experiments.options import option
    >>> @dataclass(frozen=True)
    ... class Own:
    ...     out: str = option("report", "where it goes")
    ...     live: bool = option(False, "go on")
    >>> read(["runs/", "--out", "there", "--live"], Own)
    ([PosixPath('runs')], Own(out='there', live=True))
    """
    known = {entry.name: entry for entry in fields(kind)}  # type: ignore[arg-type]
    places: list[Path] = []
    given: dict[str, Any] = {}
    left = list(arguments)
    while left:
        argument = left.pop(0)
        name, equals, text = argument.removeprefix("--").partition("=")
        dashed = argument.startswith("--")
        if not dashed and (not equals or "/" in name):
            places.append(Path(argument))
            continue
        name = name.replace("-", "_")
        if name not in known:
            raise unknown("option", name, known)
        if name in given:
            raise ConfigError(f"'{name}' is given twice")
        default = default_of(known[name])
        if not equals:
            if isinstance(default, bool):
                text = "true"
            elif left:
                text = left.pop(0)
            else:
                raise ConfigError(f"--{name} needs a value")
        given[name] = converted(name, text, default)
        check(name, given[name], known[name].metadata)
    return places, kind(**given)


def command(
    about: str,
    kind: type[Options],
    work: Callable[[list[Path], Options], None],
    arguments: Sequence[str],
    needs_places: bool = True,
) -> int:
    """Run a tool; the exit status.

    Args:
      about: its own words, for `--help`.
      kind: its options.
      work: what it does; a ConfigError or an OSError out of it is said in one line.
      arguments: of the process.
      needs_places: without arguments it has nothing to do.
    """
    if "--help" in arguments or "-h" in arguments or (needs_places and not arguments):
        print(usage(about, kind))
        return 0 if arguments else 2
    try:
        work(*read(arguments, kind))
    except (ConfigError, OSError) as error:
        return refuse(error)
    except KeyboardInterrupt:
        return refuse("interrupted", 130)
    return 0


def only(places: list[Path]) -> Path:
    """The one run directory.

    Raises:
      ConfigError: there is none, or are more.
    """
    if len(places) != 1:
        raise ConfigError("give one run directory")
    return places[0]
