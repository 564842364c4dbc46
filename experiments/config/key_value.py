"""One form of options for all commands: `--key value` and `--key=value` are read as `key=value`."""

from collections.abc import Sequence
from functools import cache

from .cell_options import library_options
from .overrides import option_kinds

FLAGS = ("-h", "--help", "-m", "--multirun", "--cfg", "--version")  # these have no value


@cache
def switches() -> set[str]:
    """Return the names of all options of true or false, those of constructors too."""
    own = {name for name, kind in option_kinds().items() if kind is bool}
    return own | {name for name, entry in library_options().items() if entry.type is bool}


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
            following = left[0] if left and not left[0].startswith("--") else None
            if name in switches() and str(following).lower() not in ("true", "false"):
                value = "true"
            elif following is None:
                found.append(argument)  # refused where it is read, as it was written
                continue
            else:
                value = left.pop(0)
        found.append(f"{name}={value}")
    return found
