"""Learn on a GPU what can be learned in a given time: sndjax gpu_suite minutes=10

In order of worth: how far losses, rewards, convolutions and an iteration are from float32 on a CPU;
the rates of whole iterations of snd_std on Venture (collecting and learning in turn, the module
beside the next rollout, overlap=1, 512 environments, four seeds, other precisions) and of
environments in JAX; then Procgen's exploration levels for the rest of the time, each run for its
share. Every measurement is a process of its own and is bounded; each result is on the disk as soon
as there is one, in OUT/<step>.jsonl, and OUT/suite.md shows all of them. The same command measures
again, and resumes every run.
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

    minutes: float = option(10.0, "for everything together, compilation too", above=0)
    out: str | None = option(
        None, "where the figures and the page go; default docs/results/gpu, with cpu: RUNS/figures"
    )
    runs: str = option("runs/gpu_suite", "where the runs are; called again it resumes them")
    envs: str = option("Coinrun,Jumper,Climber,Caveflyer", "environments of the runs, with commas")
    algos: str = option("ppo,rnd,snd_std,snd_vic,snd_vinv", "algorithms of the runs, with commas")
    at_once: int = option(
        5, "runs side by side on the GPU; each then writes what it does to a file", low=1
    )
    steps: str = option(
        "all", "measurements before the runs, with commas; all, or none for the runs alone"
    )
    measure: str = option("", "one measurement, in this process and no other; its rows are printed")
    cpu: bool = option(False, "also where jax sees no GPU: of small tasks, to try the command")


def measure_and_train(paths: list[Path], options: Options) -> None:
    """Measure, train for the rest of the time, and write the page.

    Raises:
      ConfigError: a name does not exist, there is no GPU, or runs failed.
    """
    pairs = [(env, algo) for env in options.envs.split(",") for algo in options.algos.split(",")]
    for env, algo in pairs:
        load_config([f"env={env}", f"algo={algo}"])  # a wrong name is refused before any run
    from .benchmarks.gpu_suite import Suite, print_measurement

    if options.measure:
        print_measurement(options.measure)
    else:
        runs = Path(options.runs)
        out = runs / "figures" if options.cpu else Path("docs/results/gpu")
        suite = Suite(Path(options.out or out), runs, options.minutes, options.cpu)
        suite.run(options.steps, pairs, options.at_once)


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, measure_and_train, arguments, paths="none")


if __name__ == "__main__":
    run_script(main)
