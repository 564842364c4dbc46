"""The text that `sndjax run --help` prints, of all options or of those of one method."""

from collections.abc import Sequence
from dataclasses import Field
from pathlib import Path
from typing import Any

from ..system.errors import ConfigError
from .cell_options import cell_options, library_constructor, module_options
from .compose import load_config
from .constructor_options import Constructor, read_constructor, with_default
from .help import option_lines, run_option_lines
from .library import algorithm_table
from .schema import OBJECTIVES, SIGNALS, AlgoConfig
from .user_function import split_reference
from .validation import (
    ALL_GROUPS,
    config_options,
    get_option,
    group_choices,
    unknown_name_error,
)

RUN_USAGE = """\
usage: sndjax env=NAME algo=NAME [key=value ...]     (or sndjax run ...)

Trains PPO with an intrinsic reward, for example:
  sndjax env=MountainCar algo=snd_vic
  sndjax env=Venture algo=snd_std num_seeds=3 total_steps=1_000_000
  sndjax resume=runs/Venture/snd_std/<time>-<id>
  sndjax -m env=Venture,Gravitar algo=rnd,snd_vic seed=0,9      (a sweep: docs/sweeps.md)

  --help signal=NAME, objective=NAME, algo=NAME     explains the options of one method
  --help env=NAME algo=NAME ...                     shows the defaults that hold there
  --cfg env=NAME algo=NAME ...                      prints every setting and where it comes from
  --version                                         prints the versions of what computes"""


WIDTH = 34  # of the first column, in characters


def run_help(arguments: Sequence[str] = ()) -> str:
    """Return the text that `sndjax run --help` prints with these other arguments.

    Raises:
      ConfigError: the arguments name no method, or no run.
    """
    given = dict(argument.partition("=")[::2] for argument in arguments)
    methods = [key for key in ("objective", "signal") if key in given]
    if methods:
        return "\n\n".join(method_help(key, given[key]) for key in methods)
    if "env" in given:
        return effective_help(arguments)
    if "algo.module" in given:
        return module_help(given["algo.module"])
    if "algo" in given:
        return algorithm_help(given["algo"])
    if given:
        raise ConfigError(
            f"--help {' '.join(arguments)}: give signal=NAME, objective=NAME, algo=NAME, or a run: "
            "env=NAME algo=NAME"
        )
    return general_help()


def general_help() -> str:
    """Return the text about all options."""
    lines = [RUN_USAGE]
    titles = {
        "env": "environments",
        "algo": "algorithms",
        "network": "networks, thesis by default",
        "preset": "presets, which may be left out",
    }
    for group in ALL_GROUPS:
        lines += ["", f"{titles[group]} ({group}=NAME)"]
        lines += [f"  {name:<18} {about}" for name, about in group_choices(group).items()]
    return "\n".join([*lines, "", *run_option_lines()])


def method_help(kind: str, name: str) -> str:
    """Return the text about an objective or a signal and its options.

    Args:
      kind: "objective" or "signal".
      name: its name.

    Raises:
      ConfigError: there is none of this name.
    """
    known = {"objective": OBJECTIVES, "signal": SIGNALS}[kind]
    if name not in known:
        raise unknown_name_error(kind, name, known)
    made = library_constructor(kind, name)
    options = {f"{kind}.{key}": entry for key, entry in made.options.items()}
    return constructor_help(kind, name, made, options)


def constructor_help(
    kind: str, name: str, made: Constructor, options: dict[str, Field[Any]]
) -> str:
    """Return the text about a constructor and its options.

    Args:
      kind: "objective", "signal" or "module".
      name: its name.
      made: the constructor.
      options: by dotted names, with the defaults that hold; those of other kinds are left out.
    """
    options = {key: entry for key, entry in options.items() if key.startswith(f"{kind}.")}
    lines = [f"{kind} {name}", *(f"  {line}".rstrip() for line in made.about.splitlines()), ""]
    return "\n".join([*lines, *(option_lines(options.items(), WIDTH) or ["  no options"])])


def algorithm_help(name: str) -> str:
    """Return the text about an algorithm: its objective and its signal with its defaults.

    Raises:
      ConfigError: there is no such algorithm.
    """
    if name not in group_choices("algo"):
        raise unknown_name_error("algo", name, group_choices("algo"))
    row = algorithm_table().get(name)
    about = f"algo={name}: {group_choices('algo')[name]}"
    if row is None or row.objective is None:
        return about
    options = cell_options(AlgoConfig(name=name, objective=row.objective, signal=row.signal))
    parts = [
        constructor_help(kind, own, library_constructor(kind, own), options)
        for kind, own in (("objective", row.objective), ("signal", row.signal))
    ]
    return "\n\n".join([f"{about} ({row.source})", *parts])


def module_help(reference: str) -> str:
    """Return the text about the user's function, FILE.py:FUNCTION, and its options.

    Raises:
      ConfigError: the file or the function does not exist.
    """
    path, name = split_reference("algo.module", reference)
    made = read_constructor(Path(path), name, given=2)  # num_actions, size
    if made is None:
        raise ConfigError(f"--help algo.module={reference}: {path} defines no function {name}")
    options = {f"module.{key}": entry for key, entry in made.options.items()}
    return constructor_help("module", name, made, options)


def effective_help(arguments: Sequence[str]) -> str:
    """Return the options of a run with the values that hold for it.

    Raises:
      ConfigError: the arguments describe no run.
    """
    config = load_config(list(arguments))
    named = dict(config_options()) | cell_options(config.algo) | module_options(config.algo)
    shown = []
    for name, entry in named.items():
        group, _, key = name.partition(".")
        own = getattr(config, group, None) if key else None
        value = own[key] if isinstance(own, dict) else get_option(config, name)
        shown.append((name, with_default(entry, value)))
    head = f"options of {' '.join(arguments)}, with the values that they have there"
    return "\n".join([head, *option_lines(shown, WIDTH)])
