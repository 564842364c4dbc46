"""One form of options for all commands: `--key value` and `--key=value` are read as `key=value`."""

from collections.abc import Sequence
from functools import cache

from .cell_options import library_constructor
from .library import module_names
from .overrides import option_kinds

FLAGS = ("-h", "--help", "-m", "--multirun", "--cfg", "--version")  # these have no value


@cache
def switches() -> set[str]:
    """Return the names of all options of true or false, those of constructors too."""
    found = {name for name, kind in option_kinds().items() if kind is bool}
    for kind in ("objective", "signal"):
        for name in module_names(f"{kind}s"):
            options = library_constructor(kind, name).options
            found |= {f"{kind}.{key}" for key, entry in options.items() if entry.type is bool}
    return found


def to_key_value(arguments: Sequence[str]) -> list[str]:
    """Return a command line of `sndjax run` with every option as `key=value`; flags stay.

    A dash in a name is an underscore. An option of true or false may stand without a value.

    >>> to_key_value(["--env", "Venture", "--num-seeds=3", "--algo.shuffle", "seed=1", "-m"])
    ['env=Venture', 'num_seeds=3', 'algo.shuffle=true', 'seed=1', '-m']
    """
    found, left = [], list(arguments)
    while left:
        argument = left.pop(0)
        if argument in FLAGS or not argument.startswith("--"):
            found.append(argument)
            continue
        name, equals, value = argument.removeprefix("--").partition("=")
        name = name.replace("-", "_")
        if not equals:
            is_switch = name in switches()
            if left and (left[0].lower() in ("true", "false") or not is_switch):
                if left[0].startswith("--"):
                    found.append(argument)  # refused where it is read, as it was written
                    continue
                value = left.pop(0)
            elif is_switch:
                value = "true"
            else:
                found.append(argument)
                continue
        found.append(f"{name}={value}")
    return found
