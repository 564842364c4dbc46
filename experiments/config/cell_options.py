"""The options that depend on the algorithm: those of its objective, its signal, its module.

`objective.X=`, `signal.X=` and `module.X=` are the arguments of the constructors that
`algo.objective`, `algo.signal` and `algo.module` name. A named algorithm may have other defaults.
"""

from collections.abc import Mapping
from dataclasses import Field, replace
from pathlib import Path
from types import NoneType
from typing import Any, get_args

from ..system.errors import ConfigError
from .constructor_options import Constructor, read_constructor, with_default
from .library import (
    algorithm_table,
    distillation_table,
    has_predictor,
    library_path,
    module_names,
)
from .option import option
from .schema import AlgoConfig, Config
from .user_function import split_reference
from .validation import check_range, unknown_name_error, whole_number

CELL_GROUPS = ("objective", "signal", "module")
MEASURED = {True: "must be true or false", False: "must be a number"}


def library_constructor(kind: str, name: str) -> Constructor:
    """Return the constructor of an objective or a signal of the library.

    Args:
      kind: "objective" or "signal".
      name: its name; the objective "none" has no options.
    """
    if (kind, name) == ("objective", "none"):
        return Constructor("The encoder stays random.", {})
    if name not in module_names(f"{kind}s"):
        raise unknown_name_error(kind, name, module_names(f"{kind}s"))
    made = read_constructor(library_path() / f"{kind}s" / f"{name}.py", name)
    assert made is not None, f"sndjax/{kind}s/{name}.py defines no function {name}"
    return made


def library_options() -> dict[str, Field[Any]]:
    """Return the options of every objective and signal of the library by their dotted names."""
    return {
        f"{kind}.{key}": entry
        for kind in ("objective", "signal")
        for name in module_names(f"{kind}s")
        for key, entry in library_constructor(kind, name).options.items()
    }


def changed_defaults(algo: AlgoConfig) -> dict[str, Mapping[str, Any]]:
    """Return the defaults that an algorithm and its objective set, by group.

    These are the arguments in the table of algorithms, and for a signal with a predictor how the
    experiments of the objective reduce a distillation.
    """
    row = algorithm_table().get(algo.name)
    reduced = distillation_table().get(algo.objective, {}) if has_predictor(algo.signal) else {}
    if row is None:
        return {"signal": reduced}
    return {"objective": row.objective_options, "signal": {**reduced, **row.signal_options}}


def module_options(algo: AlgoConfig) -> dict[str, Field[Any]]:
    """Return the options of the user's function by their dotted names; {} where there is none.

    The file is read, not run. That of a stored configuration, which others may have written, is
    not even read: its options have the types of their values.

    Raises:
      ConfigError: the file does not exist or cannot be read.
    """
    if algo.module is None:
        return {}
    path, name = split_reference("algo.module", algo.module)
    made = read_constructor(Path(path), name, given=2)  # num_actions, size
    return {f"module.{key}": entry for key, entry in made.options.items()} if made else {}


def cell_options(algo: AlgoConfig) -> dict[str, Field[Any]]:
    """Return the options of an algorithm's objective and signal by their dotted names."""
    if algo.module is not None:
        return {}
    row = algorithm_table().get(algo.name)
    if row is not None and row.objective is None:  # the baseline
        return {}
    found, changed = {}, changed_defaults(algo)
    for kind, name in (("objective", algo.objective), ("signal", algo.signal)):
        own = changed.get(kind, {})
        for key, entry in library_constructor(kind, name).options.items():
            now = with_default(entry, own[key]) if key in own else entry
            found[f"{kind}.{key}"] = now
    return found


def complete_config(config: Config, own: Mapping[str, Field[Any]] | None = None) -> Config:
    """Return a configuration with every option of its constructors, and each of the right type.

    Args:
      config: the configuration.
      own: the options of the user's function; None: of a stored configuration, as they are.

    Raises:
      ConfigError: there is no such option, or it may not have this value.
    """
    if own is None:
        own = {f"module.{key}": untyped(key, value) for key, value in config.module.items()}
    known = {**cell_options(config.algo), **own}
    for group in CELL_GROUPS:
        for key in getattr(config, group):
            if f"{group}.{key}" not in known:
                raise unknown_option(config.algo, group, key, known)
    made: dict[str, dict[str, Any]] = {group: {} for group in CELL_GROUPS}
    for name, entry in known.items():
        group, _, key = name.partition(".")
        given = getattr(config, group).get(key, entry.default)
        made[group][key] = convert(name, entry, given)
        check_range(name, made[group][key], entry.metadata)
    if config.ppo.ext_weight is None:
        weight = 2.0 if config.combine == "streams" else 1.0
        made["ppo"] = replace(config.ppo, ext_weight=weight)  # type: ignore[assignment]
    return replace(config, **made)  # type: ignore[arg-type]


def untyped(name: str, value: Any) -> Field[Any]:
    """Return the option of a function whose file is gone: it has the type of its value."""
    made = option(value, "")
    made.name, made.type = name, type(value)
    return made


def unknown_option(algo: AlgoConfig, group: str, key: str, known: Mapping[str, Any]) -> ConfigError:
    """Return the error for an option that a constructor does not have.

    Args:
      algo: the algorithm.
      group: of the option.
      key: its name in the group.
      known: the options that there are.
    """
    own = [name for name in known if name.startswith(f"{group}.")]
    what = {"objective": algo.objective, "signal": algo.signal, "module": algo.module}[group]
    if own:
        return ConfigError(
            f"{group}.{key}: {group} {what} has no such option; it has {', '.join(own)}"
        )
    if algo.name == "ppo" or (group == "module") != (algo.module is not None) or what is None:
        return ConfigError(f"{group}.{key}: algo={algo.name} has no {group}")
    return ConfigError(f"{group}.{key}: {group} {what} has no options")


def convert(name: str, entry: Field[Any], value: Any) -> Any:
    """Return the value of an option as its type.

    Args:
      name: of the option, for error messages.
      entry: the option.
      value: as the command line or a file gives it.

    Raises:
      ConfigError: the value is of another type.
    """
    kinds = [kind for kind in get_args(entry.type) or (entry.type,) if kind is not NoneType]
    if value is None:
        if len(kinds) == len(get_args(entry.type) or (entry.type,)):
            raise ConfigError(f"{name}=null: give a value")
        return None
    kind: Any = kinds[0]
    if kind is str:
        return str(value)
    if isinstance(value, bool) != (kind is bool) or isinstance(value, list | dict):
        raise ConfigError(f"{name}={value}: {MEASURED[kind is bool]}")
    try:
        return value if kind is bool else whole_number(str(value)) if kind is int else float(value)
    except (ValueError, OverflowError):
        kind_text = "a whole number" if kind is int else "a number"
        raise ConfigError(f"{name}={value}: must be {kind_text}") from None
