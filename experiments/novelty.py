"""Read modules' signals along a trajectory (Fig. 5.11): sndjax novelty env=MontezumaRevenge

Tests without an agent whether modules detect novelty. Each module is trained along one long
trajectory (from `sndjax trajectory`), 2,700 states in order. At every fourth step n it takes one
gradient step on 128 pairs of the past, m < n (32 segments of four, as in the thesis' minibatches).
At every 32nd step its signal is read on four windows: the past, the near future n < m < n + 128,
the far future m > n, and the whole trajectory. Seven modules take about an hour on two cores. The
result of each module is saved when it is complete; the same command computes only those that are
missing.
"""

from dataclasses import dataclass
from pathlib import Path

from .config.option import option
from .config.tool_options import run_command
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The options of the command."""

    env: str = option("MontezumaRevenge", "the game", choices=("MontezumaRevenge",))
    algos: str = option("rnd,snd_v,snd_std,snd_vic,snd_vinv,icm,sp", "modules, by name")
    out: str = option("novelty", "where figures and numbers go")
    train_every: int = option(4, "states between gradient steps", low=4)
    read_every: int = option(32, "states between readings", low=1)
    states: int = option(2700, "of the trajectory, from its start", low=300, high=2700)
    seed: int = option(0, "of the weights and the draws", low=0, high=2**31 - 1)


def study(paths: list[Path], options: Options) -> None:
    """Study every module, and write the page."""
    from .analysis.novelty_report import StudySettings, write_novelty_page

    settings = StudySettings(
        env=options.env,
        algos=[name.strip() for name in options.algos.split(",")],
        train_every=options.train_every,
        read_every=options.read_every,
        states=options.states,
        seed=options.seed,
    )
    write_novelty_page(settings, Path(options.out))


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, study, arguments, paths="none")


if __name__ == "__main__":
    run_script(main)
