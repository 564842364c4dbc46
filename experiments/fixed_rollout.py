"""Train a module repeatedly on one rollout: sndjax fixed_rollout env=Venture algo=snd_std

Collects one real rollout with the initial policy, then trains only the intrinsic module on it for
some updates, and prints the losses (means over minibatches). This shows whether a module learns at
all, while nothing else changes.
"""

from dataclasses import dataclass

from .config.option import option
from .config.schema import Config
from .config.tool_options import run_config_command
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The options of the command."""

    updates: int = option(10, "how often the rollout is learned", low=1)


def learn(config: Config, options: Options) -> None:
    """Train the module on one rollout, and print its losses."""
    from .analysis.fixed_rollout import learn_fixed_rollout

    learn_fixed_rollout(config, options.updates)


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_config_command(__doc__, Options, learn, arguments)


if __name__ == "__main__":
    run_script(main)
