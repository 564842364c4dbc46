"""One form of options for all commands: `--key value` and `--key=value` are read as `key=value`."""

from collections.abc import Sequence

from .overrides import option_kinds
from .validation import ALL_GROUPS

FLAGS = ("-h", "--help", "-m", "--multirun", "--cfg", "--version")  # these have no value


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
        takes_value = name in ALL_GROUPS or option_kinds().get(name) is not bool
        if not equals and left and (takes_value or left[0].lower() in ("true", "false")):
            value = left.pop(0)
        elif not equals and not takes_value:
            value = "true"
        elif not equals:
            found.append(argument)  # refused where it is read, as it was written
            continue
        found.append(f"{name}={value}")
    return found
