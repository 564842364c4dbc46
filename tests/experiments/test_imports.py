"""The order of the rooms: a package imports only from packages above it."""

import ast
from graphlib import TopologicalSorter

import pytest
from helpers.processes import ROOT

ORDER = [
    "system", "config", "environments", "storage", "training", "reporting", "evaluation",
    "analysis", "sweeps", "benchmarks", "trials",
]  # fmt: skip
LAB = ROOT / "experiments"
ALIASES = {"benches", "chance", "evidence", "explores", "ledger", "lowerings", "peers"}


def imports(path):
    """The modules of the laboratory that a file imports, anywhere in it, as paths below it."""
    here = path.relative_to(LAB).parent.parts
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = (*here[: len(here) - node.level + 1], *(node.module or "").split("."))
            base = tuple(filter(None, base))
            for alias in node.names:
                inner = LAB.joinpath(*base, f"{alias.name}.py")
                yield (*base, alias.name) if inner.is_file() else base
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names = [node.module] if isinstance(node, ast.ImportFrom) else node.names
            for name in (getattr(n, "name", n) for n in names):
                assert not name.startswith(("experiments", "sndjax_lab")), f"{path}: {name}"


FILES = [path for path in sorted(LAB.rglob("*.py")) if path.name != "__init__.py"]


@pytest.mark.parametrize("path", sorted(LAB.rglob("__init__.py")), ids=lambda p: p.parent.name)
def test_imports_of_init_files_are_none(path):
    tree = ast.parse(path.read_text())
    assert tree.body == [] or (len(tree.body) == 1 and ast.get_docstring(tree))


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(LAB)))
def test_imports_of_each_module_are_of_its_package_or_above(path):
    room, *below = path.relative_to(LAB).parts
    for target in imports(path):
        if below:  # in a package
            assert target[0] in ORDER[: ORDER.index(room) + 1], f"imports {'.'.join(target)}"
        elif path.stem in ALIASES:
            assert target[0] in ORDER or len(target) == 1
        else:  # a command
            assert target[0] in ORDER, f"imports {'.'.join(target)}"


def test_imports_of_the_laboratory_form_no_circle():
    graph = {path.relative_to(LAB).with_suffix("").parts: set(imports(path)) for path in FILES}
    assert list(TopologicalSorter(graph).static_order())


def test_imports_of_the_library_name_nothing_of_the_laboratory():
    for path in (ROOT / "sndjax").rglob("*.py"):
        tree = ast.parse(path.read_text())
        names = [n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
        names += [a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names]
        assert not [n for n in names if n.startswith(("experiments", "sndjax_lab"))], path
