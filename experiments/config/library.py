"""Facts about the library, read from its files without importing jax."""

import ast
import importlib.util
import sys
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any


@cache
def library_path() -> Path:
    """Return the folder of the package `sndjax`, without importing it."""
    spec = importlib.util.find_spec("sndjax")
    assert spec is not None
    assert spec.submodule_search_locations is not None
    return Path(next(iter(spec.submodule_search_locations)))


@cache
def module_names(subpackage: str) -> tuple[str, ...]:
    """Return the module names in a library subpackage; each has a constructor of its name."""
    files = (library_path() / subpackage).glob("*.py")
    return tuple(sorted(path.stem for path in files if path.stem != "__init__"))


@cache
def constructor_parameters(subpackage: str, name: str) -> tuple[str, ...]:
    """Return the parameter names of the constructor of an objective or a signal.

    Raises:
      ValueError: the file defines no function of its name.

    >>> constructor_parameters("signals", "re3")[:1]
    ('k',)
    """
    tree = ast.parse((library_path() / subpackage / f"{name}.py").read_text())
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and node.name == name:
            return tuple(arg.arg for arg in (*node.args.args, *node.args.kwonlyargs))
    raise ValueError(f"sndjax/{subpackage}/{name}.py defines no function {name}")


def has_predictor(signal: str) -> bool:
    """Return True if the signal distils the encoder into a predictor network."""
    return "predictor" in constructor_parameters("signals", signal)


def has_action_input(algorithm: str) -> bool:
    """Return True if the networks of a named algorithm take the action as input (QRND)."""
    row = algorithm_table().get(algorithm)
    return row is not None and bool(row.options.get("action_input"))


def algorithm_table() -> dict[str, Any]:
    """Return `sndjax.algorithm_table.ALGORITHMS`: the named algorithms by name."""
    return load_table().ALGORITHMS


def distillation_table() -> dict[str, Any]:
    """Return `sndjax.algorithm_table.DISTILLATION`: arguments of signals by objective."""
    return load_table().DISTILLATION


@cache
def load_table() -> ModuleType:
    """Run the file of the table, which imports nothing but types."""
    path = library_path() / "algorithm_table.py"
    spec = importlib.util.spec_from_file_location("_sndjax_algorithm_table", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
