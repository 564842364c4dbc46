"""python -m experiments.record RUN_DIR: a film of the best of some episodes, and its novel frames.

Beside the game, as envpool draws it: the novelty signal, the value estimates and the score, with
a mark at now. Written to RUN_DIR/films/: an mp4 (VP9) and a PNG of the most novel frames.
"""

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.arguments import TRUST, command, only
from experiments.options import ConfigError, option
from experiments.process import before_jax

HEIGHT, SIDE = 480, 640  # of the film, and of the traces beside the game
SHEET, APART = 12, 16  # frames on the contact sheet, and steps between two of them


@dataclass(frozen=True)
class Options:
    """What can be chosen."""

    episodes: int = option(8, "of which the best is filmed", low=1, high=1024)
    policy: str = option("sampled", "how actions are taken", choices=("sampled", "greedy"))
    seed: int = option(0, "of the environments", low=0, high=2**31 - 1)
    agent: int = option(-1, "the seed of the run whose agent plays; -1: its first", low=-1)
    steps: int = option(0, "film the first steps alone; 0: all", low=0)
    rate: int = option(30, "agent steps per second", low=1, high=240)
    out: str | None = option(None, "where the files go; default RUN_DIR/films")
    trust: str | None = option(None, TRUST)


def best_of(episodes: list[Any]) -> int:
    """Which episode has the highest return, of those with the highest score the longest."""
    key = lambda e: (e.reward.sum(), e.score.sum(), len(e.action))
    return max(range(len(episodes)), key=lambda i: key(episodes[i]))


def traces(episode: Any, novelty: np.ndarray, names: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """The drawing beside the game, uint8[HEIGHT, SIDE, 3], and the column of each step in it."""
    from experiments.style import panels, plt

    figure, axes = panels(3, 1, SIDE / 100, HEIGHT / 100, sharex=True)
    top, middle, bottom = axes[:, 0]
    steps = np.arange(len(novelty))
    top.plot(steps, novelty, color="#0072B2", linewidth=1)
    top.set_ylabel("novelty")
    for k, name in enumerate(names):
        colour = ("#000000", "#D55E00")[k]
        middle.plot(steps, episode.value[: len(steps), k], color=colour, linewidth=1, label=name)
    middle.set_ylabel("value")
    middle.legend(frameon=False, fontsize=8, loc="upper right")
    bottom.plot(steps, np.cumsum(episode.score)[: len(steps)], color="#009E73", linewidth=1.5)
    bottom.set_ylabel("score")
    bottom.set_xlabel("step (agent steps)")
    figure.set_dpi(100)
    figure.canvas.draw()
    picture = np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()  # type: ignore[attr-defined]
    columns = bottom.transData.transform(np.stack([steps, steps], 1))[:, 0].round().astype(int)
    plt.close(figure)
    return picture, columns


def frames_of(
    pictures: Iterator[np.ndarray], side: np.ndarray, columns: np.ndarray
) -> Iterator[np.ndarray]:
    """The film's frames, uint8[HEIGHT, *, 3]: the game, and the traces with a line at now."""
    import cv2

    for picture, column in zip(pictures, columns, strict=False):
        height, width = picture.shape[:2]
        wide = 2 * round(HEIGHT * width / height / 2)
        game = cv2.resize(
            picture,
            (wide, HEIGHT),
            interpolation=cv2.INTER_AREA if height > HEIGHT else cv2.INTER_NEAREST,
        )
        marked = side.copy()
        marked[:, max(column - 1, 0) : column + 1] = (200, 30, 30)
        yield np.concatenate([game, marked], axis=1)


def write_film(
    path: Path, frames: Iterator[np.ndarray], rate: int, report: Callable[[int], None]
) -> int:
    """Write an mp4; the number of frames in it.

    Raises:
      OSError: it cannot be written.
    """
    import cv2

    writer, written = None, 0
    new = path.with_name(f".new-{path.name}")  # the film has its name when it is whole
    try:
        for frame in frames:
            if writer is None:
                size = frame.shape[1], frame.shape[0]
                code = cv2.VideoWriter.fourcc(*"vp09")
                writer = cv2.VideoWriter(str(new), cv2.CAP_FFMPEG, code, rate, size)
                if not writer.isOpened():
                    raise OSError(f"cannot write {path}")
            writer.write(frame[..., ::-1])
            written += 1
            report(written)
        if writer is not None:
            writer.release()
        if cv2.VideoCapture(str(new)).get(cv2.CAP_PROP_FRAME_COUNT) != written:
            raise OSError(f"{path} could not be written whole: is the disk full?")
        new.replace(path)
    finally:
        new.unlink(missing_ok=True)
    return written


def most_novel(novelty: np.ndarray, count: int = SHEET, apart: int = APART) -> np.ndarray:
    """The steps of the highest novelty, none nearer to another than `apart`, in order of time.

    >>> most_novel(np.array([0.0, 5.0, 4.0, 0.0, 3.0]), count=2, apart=2).tolist()
    [1, 4]
    """
    chosen: list[int] = []
    for step in np.argsort(-novelty, kind="stable").tolist():
        if all(abs(step - other) >= apart for other in chosen):
            chosen.append(step)
        if len(chosen) == count:
            break
    return np.array(sorted(chosen))


def contact_sheet(pictures: dict[int, np.ndarray], novelty: np.ndarray, out: Path) -> Path:
    """The most novel frames with their steps and their signal, as a PNG."""
    from experiments.style import panels, save

    height, width = next(iter(pictures.values())).shape[:2]
    rows = -(-len(pictures) // 4)
    figure, axes = panels(rows, 4, 8.4, rows * (2.1 * height / width + 0.3))
    for one in axes.flat:
        one.axis("off")
    for one, (step, picture) in zip(axes.flat, pictures.items(), strict=False):
        one.imshow(picture)
        one.set_title(f"step {step:,}: {novelty[step]:.3g}", fontsize=9)
    return save(figure, out.parent, out.name)


def record(run: Path, options: Options) -> list[Path]:
    """Play, choose, draw: the files that were written.

    Raises:
      ConfigError: there is no agent to play, or its task cannot be drawn.
      OSError: the files cannot be written.
    """
    from experiments.player import load, novelty, pictures, play
    from experiments.progress import Bars

    players = {player.seed: player for player in load(run, options.trust)}
    player = players.get(options.agent if options.agent >= 0 else min(players))
    if player is None:
        raise ConfigError(f"{run}: there is no seed {options.agent}; it has {sorted(players)}")
    with Bars() as bars:
        played = play(
            player,
            options.episodes,
            options.policy == "greedy",
            options.seed,
            True,
            lambda t, n: bars.to("playing", n, options.episodes, f"episodes, step {t:,}"),
        )
        episode = played[best_of(played)]
        signal = novelty(player, episode)
        length = min(options.steps or len(signal), len(signal))
        signal = signal[:length]
        heads = ["external", "intrinsic"][: episode.value.shape[1]]
        side, columns = traces(episode, signal, heads)
        out = Path(options.out) if options.out else run / "films"
        out.mkdir(parents=True, exist_ok=True)
        name = f"seed-{player.seed}-iteration-{player.iteration}"
        wanted = set(most_novel(signal).tolist())
        shown: dict[int, np.ndarray] = {}

        def kept() -> Iterator[np.ndarray]:
            for step, picture in enumerate(pictures(player, episode)):
                if step in wanted:
                    shown[step] = picture.copy()
                yield picture

        film = out / f"{name}.mp4"
        frames = frames_of(kept(), side, columns)
        write_film(film, frames, options.rate, partial(bars.to, "filming", total=length))
        sheet = contact_sheet(shown, signal, out / f"{name}-most-novel")
    print(
        f"the best of {len(played)}: return {episode.reward.sum():g}, score "
        f"{episode.score.sum():g}, {len(episode.action):,} steps"
    )
    return [film, sheet]


def work(places: list[Path], options: Options) -> None:
    """Make the film and name the files."""
    for path in record(only(places), options):
        print(path.resolve())


def main(arguments: list[str]) -> int:
    """The command."""
    return command(str(__doc__), Options, work, arguments)


if __name__ == "__main__":
    before_jax()
    sys.exit(main(sys.argv[1:]))
