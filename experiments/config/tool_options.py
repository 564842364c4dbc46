"""The command lines of the tools: paths, and options as `key=value` or `--key value`."""

from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal, TypeVar

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from ..system.errors import ConfigError, print_error
from ..system.files import exists, is_file
from ..system.jax_settings import jax_problem
from ..system.process import configure_xla
from .compose import load_config
from .help import default_of, tool_help
from .key_value import to_key_value
from .saved import CONFIG
from .schema import Config
from .validation import check_range, unknown_name_error, whole_number

Options = TypeVar("Options")
TRUSTED = ("algo.module", "env.id")  # the options of a run that name code
TRUST = "code that the run's configuration may name; or repeat its algo.module=... and env.id=..."


def convert_value(name: str, text: str, default: Any) -> Any:
    """Convert the text of an option to the type of its default.

    Args:
      name: the name of the option, for error messages.
      text: the text that the command line gives.
      default: the default of the option; with None the text is returned unchanged.

    Raises:
      ConfigError: the text is not a value of that type.
    """
    try:
        if isinstance(default, bool):
            return {"true": True, "false": False}[text.lower()]
        if default is None:
            return text
        return (whole_number if type(default) is int else type(default))(text)
    except (ValueError, KeyError):
        kind = {bool: "true or false", int: "a whole number", float: "a number"}[type(default)]
        raise ConfigError(f"{name}={text}: must be {kind}") from None


def parse_arguments(arguments: Sequence[str], kind: type[Options]) -> tuple[list[Path], Options]:
    """Return the paths and the options that a command line gives.

    Args:
      arguments: the arguments of the process, without its name.
      kind: a dataclass whose fields are made by `experiments.config.schema.option`.

    Raises:
      ConfigError: an option does not exist, is given twice, has no value, or is out of its range.

    >>> from dataclasses import dataclass
    >>> from experiments.config.option import option
    >>> @dataclass(frozen=True)
    ... class Own:
    ...     out: str = option("report", "where it goes")
    ...     live: bool = option(False, "go on")
    >>> parse_arguments(["runs/", "--out", "there", "--live"], Own)
    ([PosixPath('runs')], Own(out='there', live=True))

    A field `trust` collects the values of `trust=`, `algo.module=` and `env.id=`.
    """
    known = {entry.name: entry for entry in fields(kind)}  # type: ignore[arg-type]
    paths: list[Path] = []
    given: dict[str, Any] = {}
    left = list(arguments)
    while left:
        argument = left.pop(0)
        name, equals, text = argument.removeprefix("--").partition("=")
        dashed = argument.startswith("--")
        if not dashed and (not equals or "/" in name):
            paths.append(Path(argument))
            continue
        name = name.replace("-", "_")
        trusts = "trust" in known and name in ("trust", *TRUSTED)
        if name not in known and not trusts:
            if not dashed and exists(Path(argument)):
                paths.append(Path(argument))  # a path that holds an equals sign
                continue
            raise unknown_name_error("option", name, known)
        if name in given and not trusts:
            raise ConfigError(f"'{name}' is given twice")
        default = default_of(known["trust" if trusts else name])
        if not equals:
            if isinstance(default, bool):
                text = "true"
            elif left:
                text = left.pop(0)
            else:
                raise ConfigError(f"--{name} needs a value")
        if trusts:  # several runs may name several pieces of code
            given["trust"] = (*given.get("trust", ()), unquote_value(text))
            continue
        given[name] = convert_value(name, text, default)
        check_range(name, given[name], known[name].metadata)
    return paths, kind(**given)


def unquote_value(text: str) -> str:
    """Return the value of an option of a run, without the quotes that `option_text` may add."""
    if text[:1] not in ("'", '"'):
        return text
    try:
        return str(OverridesParser.create().parse_override(f"x={text}").value())
    except HydraException:
        return text


def asks_for_help(arguments: Sequence[str]) -> bool:
    """Return True if a command line asks for help."""
    return any(argument in ("-h", "--help") for argument in arguments)


def exit_status(body: Callable[[], None]) -> int:
    """Run the body of a tool and return its exit status; print an error as one line on stderr."""
    configure_xla()
    try:
        body()
    except (ConfigError, OSError) as error:
        return print_error(error)
    except KeyboardInterrupt:
        return print_error("interrupted", 130)
    except (AssertionError, RuntimeError, ValueError) as error:
        problem = jax_problem(error)
        if problem is None:
            raise
        return print_error(problem)
    return 0


def run_command(
    about: str | None,
    kind: type[Options],
    body: Callable[[list[Path], Options], None],
    arguments: Sequence[str],
    paths: Literal["needed", "optional", "none"] = "needed",
) -> int:
    """Run a tool that takes paths and tool options, and return the exit status.

    Args:
      about: the docstring of the tool, for `--help`.
      kind: the dataclass of the tool's options.
      body: the function that gets the paths and the options; a ConfigError or an OSError that it
        raises is printed as one line.
      arguments: the arguments of the process.
      paths: "needed": without arguments the tool only prints its help; "optional": the tool also
        runs without arguments; "none": the same, but paths are refused.
    """
    if asks_for_help(arguments) or (paths == "needed" and not arguments):
        print(tool_help(str(about), kind))
        return 0 if arguments else 2

    def parsed_body() -> None:
        given, options = parse_arguments(arguments, kind)
        if given and paths == "none":
            raise ConfigError(f"'{given[0]}': write key=value")
        body(given, options)

    return exit_status(parsed_body)


def run_config_command(
    about: str | None,
    kind: type[Options],
    body: Callable[[Config, Options], None],
    arguments: Sequence[str],
    preset: Sequence[str] = (),
) -> int:
    """Run a tool that takes the options of `sndjax run` and tool options.

    Args:
      about: the docstring of the tool, for `--help`.
      kind: the dataclass of the tool's options.
      body: the function that gets the configuration and the tool's options.
      arguments: the arguments of the process.
      preset: options of `sndjax run` that the tool sets, such as "algo=ppo".

    Returns:
      The exit status.
    """
    if asks_for_help(arguments) or not arguments:
        print(tool_help(str(about), kind, takes_run_options=True))
        return 0 if arguments else 2

    def parsed_body() -> None:
        own, others = split_arguments(arguments, kind)
        others = to_key_value(others)
        options = parse_arguments(own, kind)[1]
        body(load_config([*preset, *others]), options)

    return exit_status(parsed_body)


def split_arguments(arguments: Sequence[str], kind: Any) -> tuple[list[str], list[str]]:
    """Return the arguments that are options of `kind`, and all other arguments.

    >>> from dataclasses import dataclass
    >>> from experiments.config.option import option
    >>> @dataclass(frozen=True)
    ... class Own:
    ...     updates: int = option(10, "how many")
    >>> split_arguments(["env=Venture", "--updates", "3", "seed=1"], Own)
    (['--updates', '3'], ['env=Venture', 'seed=1'])
    """
    known = {entry.name: entry for entry in fields(kind)}
    own, others, left = [], [], list(arguments)
    while left:
        argument = left.pop(0)
        name, equals, _ = argument.removeprefix("--").partition("=")
        name = name.replace("-", "_")
        if name not in known:
            others.append(argument)
            continue
        own.append(argument)
        if not equals and left and not isinstance(default_of(known[name]), bool):
            own.append(left.pop(0))  # --key value
    return own, others


def single_run(paths: list[Path]) -> Path:
    """Return the only run directory of a command line.

    Raises:
      ConfigError: no path is given, or more than one.
    """
    if len(paths) != 1:
        raise ConfigError("give one run directory")
    if not is_file(paths[0] / CONFIG):
        raise ConfigError(f"{paths[0]}: there is no run (no {CONFIG})")
    return paths[0]
