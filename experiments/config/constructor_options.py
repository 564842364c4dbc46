"""The options of a constructor, read from the source of its function without running it.

An argument with a default is an option: its annotation says the type, the words or the range, its
line under `Args:` the meaning. Nothing is imported, so that a command line is checked at once.
"""

import ast
import operator
from collections.abc import Iterator, Mapping
from dataclasses import Field
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from ..system.errors import ConfigError
from .library import library_path
from .option import option

KINDS = {"bool": bool, "int": int, "float": float, "str": str}
OPERATORS: dict[type, Any] = {
    ast.Div: operator.truediv,
    ast.Mult: operator.mul,
    ast.Add: operator.add,
    ast.Sub: operator.sub,
}


DEEPEST = 20  # names that stand for names, and types within types


class Limits(NamedTuple):
    """What an annotation says about an argument.

    Attributes:
      kind: bool, int, float or str; None: not known.
      choices: the words that it may be, or None.
      bounds: low, above and high, where there are any.
      nullable: whether it may be None.
    """

    kind: type | None = None
    choices: tuple[str, ...] | None = None
    bounds: Mapping[str, float] = MappingProxyType({})
    nullable: bool = False


class Constructor(NamedTuple):
    """A function that makes an objective, a signal or a module.

    Attributes:
      about: its docstring before `Args:`.
      options: the arguments that have a default, as fields with their meaning and range.
    """

    about: str
    options: dict[str, Field[Any]]


@cache
def read_source(path: Path) -> ast.Module:
    """Parse a Python file.

    Raises:
      ConfigError: the file cannot be read.
    """
    try:
        return ast.parse(path.read_text())
    except (OSError, SyntaxError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read: {error}") from None


def read_constructor(path: Path, name: str, given: int = 0) -> Constructor | None:
    """Return the docstring and the options of a function; None if the file does not define it.

    Arguments without a default, and those whose default or type is none of true and false, numbers
    and words, are not options. A name that the file imports or makes otherwise is not found.

    Args:
      path: the file.
      name: of the function.
      given: the number of its first arguments that are always passed, and are no options.

    Raises:
      ConfigError: the file cannot be read.
    """
    for node in read_source(path).body:
        if isinstance(node, ast.FunctionDef) and node.name == name:
            text = ast.get_docstring(node) or ""
            meanings = argument_meanings(text)
            found: dict[str, Field[Any]] = {}
            for argument, default in arguments_with_defaults(node, given):
                made = make_option(path, argument, default, meanings.get(argument.arg, ""))
                if made is not None:
                    found[argument.arg] = made
            return Constructor(text.partition("\nArgs:")[0].partition(">>>")[0].strip(), found)
    return None


def arguments_with_defaults(
    node: ast.FunctionDef, given: int = 0
) -> Iterator[tuple[ast.arg, ast.expr]]:
    """Yield the arguments that have a default and can be passed by name, each with the default.

    Args:
      node: the function.
      given: the number of its first arguments that are left out.
    """
    names, defaults = [*node.args.posonlyargs, *node.args.args], node.args.defaults
    without = len(names) - len(defaults)
    for i in range(max(without, given, len(node.args.posonlyargs)), len(names)):
        yield names[i], defaults[i - without]
    for name, default in zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True):
        if default is not None:
            yield name, default


def make_option(path: Path, argument: ast.arg, default: ast.expr, about: str) -> Field[Any] | None:
    """Return an argument as a field, or None if it is not an option.

    Args:
      path: the file of the function.
      argument: with its annotation.
      default: its default.
      about: its meaning.
    """
    try:
        value = literal(default)
        limits = read_annotation(path, argument.annotation)
    except (ValueError, TypeError, ArithmeticError):
        return None
    kind = limits.kind or (type(value) if type(value) in KINDS.values() else None)
    if kind is None:
        return None
    value = float(value) if kind is float and isinstance(value, int) else value
    made = option(value, about, choices=limits.choices, **limits.bounds)
    made.name, made.type = argument.arg, kind | None if limits.nullable else kind
    return made


def literal(node: ast.expr) -> Any:
    """Return the value of an expression of numbers and words, such as `1 / 25`.

    Raises:
      ValueError: it is none.

    >>> literal(ast.parse("-1 / 4", mode="eval").body)
    -0.25
    """
    if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
        return OPERATORS[type(node.op)](literal(node.left), literal(node.right))
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        return -literal(node.operand)
    value = ast.literal_eval(node)
    if not isinstance(value, bool | int | float | str | None):
        raise ValueError(f"{ast.unparse(node)} is no number and no word")
    return value


def read_annotation(path: Path, node: ast.expr | None, depth: int = 0) -> Limits:
    """Return what an annotation says: a type, `Literal`, `Annotated` with a `Range`, a name of one.

    Args:
      path: the file that it stands in, where names are looked up.
      node: the annotation.
      depth: of names that stand for names; beyond `DEEPEST` nothing is known.
    """
    if depth > DEEPEST:
        return Limits()
    if isinstance(node, ast.Constant) and node.value is None:
        return Limits(nullable=True)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitOr):
        sides = [read_annotation(path, side, depth + 1) for side in (node.left, node.right)]
        known = next((side for side in sides if side.kind), Limits())
        return known._replace(nullable=any(side.nullable for side in sides))
    if isinstance(node, ast.Name):
        if node.id in KINDS:
            return Limits(KINDS[node.id])
        place, meant = find_definition(path, node.id)
        return read_annotation(place, meant, depth + 1)
    if isinstance(node, ast.Subscript):
        parts = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        outer = ast.unparse(node.value).rpartition(".")[2]
        if outer == "Literal":
            words = [literal(part) for part in parts]
            return Limits(type(words[0]), tuple(map(str, words)))
        if outer == "Optional":
            return read_annotation(path, parts[0], depth + 1)._replace(nullable=True)
        if outer == "Annotated":
            found = read_annotation(path, parts[0], depth + 1)
            calls = [part for part in parts[1:] if isinstance(part, ast.Call)]
            return found._replace(bounds=read_range(calls))
    return Limits()


def read_range(calls: list[ast.Call]) -> dict[str, float]:
    """Return the bounds of `sndjax.ranges.Range(...)` among the calls of an annotation."""
    for call in calls:
        if ast.unparse(call.func).rpartition(".")[2] == "Range":
            names = ("low", "above", "high")
            found = dict(zip(names, map(literal, call.args), strict=False))
            found |= {str(word.arg): literal(word.value) for word in call.keywords}
            return {name: bound for name, bound in found.items() if bound is not None}
    return {}


def find_definition(path: Path, name: str) -> tuple[Path, ast.expr | None]:
    """Return the file and the expression that a name stands for; None if it cannot be found.

    Names may be imported from `sndjax`.

    Args:
      path: the file that uses the name.
      name: the name.
    """
    for node in read_source(path).body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sndjax."):
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    inner = str(node.module).split(".")[1:]
                    place = library_path().joinpath(*inner).with_suffix(".py")
                    return place, assigned_value(place, alias.name)
    return path, assigned_value(path, name)


def assigned_value(path: Path, name: str) -> ast.expr | None:
    """Return the expression that a file assigns to a name; None if it does not."""
    for node in read_source(path).body if path.is_file() else ():
        if isinstance(node, ast.Assign) and any(
            isinstance(target, ast.Name) and target.id == name for target in node.targets
        ):
            return node.value
    return None


def argument_meanings(text: str) -> dict[str, str]:
    """Return the meaning of each argument that a docstring lists under `Args:`, on one line.

    >>> argument_meanings("Make it.\\n\\nArgs:\\n  k: of neighbours,\\n    at least 1.\\n\\nMore.")
    {'k': 'of neighbours, at least 1'}
    """
    found: dict[str, str] = {}
    name = ""
    for line in text.partition("\nArgs:\n")[2].splitlines():
        if line.startswith("    ") and name:
            found[name] += f" {line.strip()}"
        elif line.startswith("  "):
            name, _, meaning = line.strip().partition(": ")
            found[name] = meaning
        else:
            break
    return {name: meaning.rstrip(".") for name, meaning in found.items()}


def with_default(entry: Field[Any], default: Any) -> Field[Any]:
    """Return a field with another default."""
    made = option(default, **{**entry.metadata})
    made.name, made.type = entry.name, entry.type
    return made
