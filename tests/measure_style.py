"""Measure how the code is documented: python tests/measure_style.py [--list]

Counts, for the library and for the laboratory: public functions of three parameters or more
without an `Args:` section, docstrings of functions that open with no verb of `VERBS` (add yours),
parameters of inner functions without a type, modules above 300 lines, functions above 60 lines
(docstrings not counted). --list prints each place.
"""

import ast
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
VERBS = """
Accept Add Allocate Append Apply Average Build Call Check Close Collect Compile Compute
Connect Convert Copy Count Create Cut Describe Divide Do Draw Encode End Estimate Extend
Find Flush Format Fsync Gather Give Group Handle Ignore Join Keep Label Let Load Lock Log
Look Make Mark Measure Merge Open Parse Play Prepare Print Push Put Quote Raise Read Record
Register Release Remove Replace Resample Reset Reshape Restore Return Run Save Search See
Send Set Show Slice Smooth Split Start Step Stop Store Study Subtract Sum Take Tell Time Train Turn
Update Wait Walk Warn Wrap Write Yield
"""
MODULE_LINES, FUNCTION_LINES = 300, 60


def own_parameters(node):
    """The parameters of a function, self and cls not counted."""
    given = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    return [arg for arg in given if arg.arg not in ("self", "cls")]


def is_property(node):
    """Whether a function is read as an attribute, so that a noun describes it."""
    return any(isinstance(d, ast.Name) and d.id == "property" for d in node.decorator_list)


def body_lines(node):
    """The lines of a function without its docstring."""
    first = node.body[0]
    documented = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
    skipped = first.end_lineno - first.lineno + 1 if documented else 0
    return node.end_lineno - node.lineno + 1 - skipped


def measure(folder):
    """What is found in a folder: name of the measure -> (places, how many were looked at)."""
    found = {
        "no_args": [], "no_verb": [], "inner_untyped": [], "long_modules": [], "long_functions": [],
    }  # fmt: skip
    counts = dict.fromkeys(found, 0)
    for path in sorted((ROOT / folder).rglob("*.py")):
        text = path.read_text()
        tree = ast.parse(text)
        lines = len(text.splitlines())
        counts["long_modules"] += 1
        if lines > MODULE_LINES:
            found["long_modules"].append(f"{path.relative_to(ROOT)}: {lines}")
        inner = {
            child
            for outer in ast.walk(tree)
            if isinstance(outer, ast.FunctionDef)
            for child in ast.walk(outer)
            if isinstance(child, ast.FunctionDef) and child is not outer
        }
        for node in ast.walk(tree):
            if not isinstance(node, ast.FunctionDef):
                continue
            place = f"{path.relative_to(ROOT)}:{node.lineno} {node.name}"
            doc, parameters = ast.get_docstring(node), own_parameters(node)
            counts["long_functions"] += 1
            if body_lines(node) > FUNCTION_LINES:
                found["long_functions"].append(f"{place}: {body_lines(node)}")
            if node in inner:
                counts["inner_untyped"] += len(parameters)
                found["inner_untyped"] += [
                    f"{place}({arg.arg})" for arg in parameters if arg.annotation is None
                ]
            if doc is None:
                continue
            public = not node.name.startswith("_") and node not in inner
            if public and len(parameters) >= 3:
                counts["no_args"] += 1
                if "Args:" not in doc:
                    found["no_args"].append(place)
            if not is_property(node):
                counts["no_verb"] += 1
                if doc.split()[0].rstrip(",.:") not in VERBS.split():
                    found["no_verb"].append(place)
    return {name: (found[name], counts[name]) for name in found}


def main():
    """Print the table."""
    for folder in ("sndjax", "experiments"):
        print(folder)
        for name, (places, count) in measure(folder).items():
            print(f"  {name:<16}{len(places):>5} of {count}")
            if "--list" in sys.argv:
                print("".join(f"    {place}\n" for place in places), end="")


if __name__ == "__main__":
    main()
