"""Record a video of an agent, with its novelty signal: sndjax record RUN_DIR

Plays some episodes and records the best. The video shows the game as envpool draws it, and beside
it the novelty signal, the value estimates and the score, with a mark at the current step. Writes an
mp4 (VP9) and a PNG of the most novel frames to RUN_DIR/films/.
"""

from dataclasses import dataclass
from pathlib import Path

from .config.option import option
from .config.tool_options import TRUST, run_command, single_run
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The options of the command."""

    episodes: int = option(8, "to play; the video shows the best", low=1, high=1024)
    policy: str = option("sampled", "how actions are taken", choices=("sampled", "greedy"))
    seed: int = option(0, "of the environments", low=0, high=2**31 - 1)
    agent: int = option(-1, "the seed of the run whose agent plays; -1: its first", low=-1)
    max_steps: int = option(4500, "of an episode; one without end is cut, and said to be", low=1)
    steps: int = option(0, "film only the first steps; 0: all", low=0)
    rate: int = option(30, "agent steps per second", low=1, high=240)
    out: str | None = option(None, "where the files go; default RUN_DIR/films")
    trust: tuple[str, ...] = option((), TRUST)


def record(paths: list[Path], options: Options) -> None:
    """Record the video, and print the paths of the files."""
    run = single_run(paths)
    from .evaluation.video import FilmSettings, record_film

    settings = FilmSettings(
        episodes=options.episodes,
        greedy=options.policy == "greedy",
        seed=options.seed,
        agent=options.agent,
        steps=options.steps,
        rate=options.rate,
        out=Path(options.out) if options.out else run / "films",
        trust=options.trust,
        max_steps=options.max_steps,
    )
    for path in record_film(run, settings):
        print(path.resolve())


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, record, arguments)


if __name__ == "__main__":
    run_script(main)
