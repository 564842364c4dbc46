"""Count the rewarded episodes of a random agent: sndjax random_agent env=CoinrunEasy keep=10

Plays total_steps with an agent that draws actions uniformly, and prints how many episodes had a
reward: if there is none, a novelty bonus can help. keep=10 keeps an action for ten steps on average
(1, the default: every action is drawn).
"""

from dataclasses import dataclass

from .config.option import option
from .config.schema import Config
from .config.tool_options import run_config_command
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The options of the command."""

    keep: float = option(1.0, "steps that an action is kept, on average", low=1)


def play(config: Config, options: Options) -> None:
    """Play with random actions, and print one line of results."""
    from .benchmarks.random_agent import print_random_agent

    print_random_agent(config, options.keep)


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_config_command(__doc__, Options, play, arguments, preset=["algo=ppo"])


if __name__ == "__main__":
    run_script(main)
