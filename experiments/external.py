"""Run another project's RND on our task: sndjax external SCRIPT.py peer=cleanrl seed=0

Runs a training script of another project, read from a file, on our MountainCar with reward only at
the goal. The training code of the script runs unchanged; only what belongs to Atari is replaced by
ours: the environments, the networks (for vectors, 64 wide), the size of a frame, the log. Two
settings of the script are changed: num_envs is 32, as in our runs, and CleanRL initialises its
normalisation for one rollout instead of 50; settings= changes others. Writes
OUT/<peer>-<seed>.json (with the settings in its name, if any are given) for `sndjax seed_table`.
The episodes of the random warm-up at the start of the scripts are not counted.

    peer=cleanrl      CleanRL's ppo_rnd_envpool.py (needs torch, tyro, gym)
    peer=rlexplore    RLeXplore's "3 rlexplore_with_cleanrl.py", with its RND instead of its RE3
                      (needs torch, tyro, rllte-core)
    peer=purejaxrl    PureJaxRL's ppo.py: its speed beside ours, with the same network, environments
                      and minibatches in one process, and that of RND on top
                      (needs gymnax, distrax); writes OUT/purejaxrl.json
"""

from dataclasses import dataclass
from pathlib import Path

from .config.option import option
from .config.tool_options import run_command
from .system.errors import ConfigError
from .system.files import is_file
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The options of the command."""

    peer: str = option(
        "cleanrl", "whose script it is", choices=("cleanrl", "rlexplore", "purejaxrl")
    )
    seed: int = option(0, "of the script and of the environments", low=0)
    steps: int = option(1_003_520, "that the script trains for, rounded down to rollouts", low=1)
    settings: str = option(
        "",
        "options of the script, with commas: learning_rate=5e-4,norm_adv=false; rnd.beta=0.1; "
        "NUM_ENVS=512,NUM_MINIBATCHES=64",
    )
    out: str = option("runs/peers", "where the run's figures go")


def external(paths: list[Path], options: Options) -> None:
    """Run the script, and write its figures.

    Raises:
      ConfigError: not one existing script is given, or it cannot be run.
    """
    if len(paths) != 1:
        raise ConfigError("give one script")
    if not is_file(paths[0]):
        raise ConfigError(f"{paths[0]}: there is no such file; give the script")
    from .benchmarks.external.run_script import run_peer

    out = Path(options.out)
    run_peer(paths[0], options.peer, options.seed, options.steps, options.settings, out)


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, external, arguments)


if __name__ == "__main__":
    run_script(main)
