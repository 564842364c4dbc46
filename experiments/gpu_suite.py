"""Train the thesis' hard games on a GPU for a given time: sndjax gpu_suite --minutes 240

Trains SND-VIC, SND-STD, RND and PPO on Montezuma's Revenge and Venture at the thesis' settings,
--at-once of them side by side, each for its share of the minutes; at the end each run writes a
checkpoint and stops. The same command resumes every run. Writes a directory for each run, and one
page about all of them.
"""

from dataclasses import dataclass
from pathlib import Path

from .config.compose import load_config
from .config.option import option
from .config.tool_options import run_command
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The options of the command."""

    minutes: float = option(60.0, "for all runs together, compilation too", above=0)
    out: str = option("runs/evidence", "where the runs are; called again it resumes them")
    envs: str = option("MontezumaRevenge,Venture", "environments, with commas")
    algos: str = option("snd_vic,snd_std,rnd,ppo", "algorithms, with commas")
    at_once: int = option(
        1, "runs side by side on the GPU; each then writes what it does to a file", low=1
    )
    cpu: bool = option(False, "also where jax sees no GPU")


def train(paths: list[Path], options: Options) -> None:
    """Train every run for its share of the time, and write the page.

    Raises:
      ConfigError: an environment or algorithm does not exist, there is no GPU, or runs failed.
    """
    from .benchmarks.gpu_suite import run_suite

    pairs = [(env, algo) for env in options.envs.split(",") for algo in options.algos.split(",")]
    for env, algo in pairs:
        load_config([f"env={env}", f"algo={algo}"])  # a wrong name is refused before any run
    run_suite(pairs, Path(options.out), options.minutes, options.at_once, options.cpu)


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, train, arguments, paths="none")


if __name__ == "__main__":
    run_script(main)
