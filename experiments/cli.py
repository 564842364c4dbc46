"""The one command `sndjax`: a table from command to module.

`sndjax env=Venture algo=snd_std` is `sndjax run ...`; each command is a file beside this one with a
`main(arguments)`, and `python -m experiments.<command>` runs it too.
"""

from importlib import import_module
from importlib.util import find_spec

from .system.errors import print_error
from .system.process import run_script

COMMANDS = {
    "run": "train one agent, or with -m a sweep of them",
    "demo": "train PPO and SND-VIC on MountainCar, and draw both learning curves",
    "report": "write one page of any runs",
    "evaluate": "measure how well an agent plays",
    "record": "film an agent, with its novelty signal",
    "replay": "repeat an update that produced NaN or Inf",
    "sweep": "show how far each job of a sweep is",
    "seed_table": "print the table of a sweep, a line for each algorithm",
    "analyze": "compare the feature spaces of trained modules",
    "novelty": "read modules' signals along a recorded trajectory",
    "trajectory": "search for such a trajectory",
    "fixed_rollout": "learn one rollout again and again: does a module learn at all?",
    "random_agent": "count how often chance alone is rewarded",
    "bench": "measure where the time of a run goes",
    "bench_suite": "compare every algorithm's benchmark with the committed figures",
    "cost": "count what every algorithm's products cost",
    "compiled_cost": "print what the compiled updates compute",
    "convolutions": "time a convolution's implementations side by side",
    "budget": "estimate what a sweep costs",
    "gpu_suite": "learn what can be learned on a GPU in a given time",
    "trial": "tune and run the rows of the trial: trained encoders against random ones",
    "external": "run another project's RND on our task",
}
ALIASES = {  # earlier names
    "explores": "seed_table",
    "chance": "random_agent",
    "benches": "bench_suite",
    "ledger": "compiled_cost",
    "lowerings": "convolutions",
    "evidence": "gpu_suite",
    "peers": "external",
}

LAB_PACKAGES = ("envpool", "gymnasium", "hydra", "matplotlib", "omegaconf")  # of the extra `lab`


def help_text() -> str:
    """Return the text that `sndjax --help` prints."""
    lines = [
        "usage: sndjax env=NAME algo=NAME [key=value ...]     train: the same as sndjax run ...",
        "       sndjax COMMAND ...",
        "       sndjax --version",
        "",
        "commands (sndjax COMMAND --help says more)",
        *(f"  {name:<14} {about}" for name, about in COMMANDS.items()),
        "",
        "for example:",
        "  sndjax env=MountainCar algo=snd_vic",
        "  sndjax report runs/",
    ]
    return "\n".join(lines)


def split_command(arguments: list[str]) -> tuple[str, list[str]]:
    """Return the command that a command line names, and its arguments.

    A command line that begins with an option (`key=value` or `-m`) is `run`.

    >>> split_command(["env=Venture", "algo=rnd"])
    ('run', ['env=Venture', 'algo=rnd'])
    >>> split_command(["chance", "env=Venture"])
    ('random_agent', ['env=Venture'])
    """
    if arguments[0].startswith("-") or "=" in arguments[0]:
        return "run", arguments
    name = arguments[0].replace("-", "_")
    return ALIASES.get(name, name), arguments[1:]


def main(arguments: list[str]) -> int:
    """Run the command that the arguments name, and return its exit status."""
    if not arguments or (arguments[0] in ("-h", "--help", "help") and len(arguments) == 1):
        print(help_text())
        return 0 if arguments else 2
    if missing := [package for package in LAB_PACKAGES if find_spec(package) is None]:
        return print_error(
            f"{missing[0]} is not installed: the commands are the laboratory, and this is the "
            "library alone; run: pip install 'sndjax[lab]'"
        )
    if arguments[0] == "--version":
        from .system.versions import version_line

        print(version_line())
        return 0
    name, rest = split_command(arguments)
    if name not in COMMANDS:
        from .config.validation import unknown_name_error

        return print_error(unknown_name_error("command", name, COMMANDS))
    module = import_module(f".{name}", __package__)
    return module.main(rest)


def console() -> None:
    """Run the `sndjax` script."""
    run_script(main)


if __name__ == "__main__":
    console()
