"""A film of the best of several episodes, and a contact sheet of its most novel frames."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from ..reporting.plot_style import make_panels, plt, save_figure
from ..system.display import ProgressBars
from ..system.errors import ConfigError
from .players import (
    PlayedEpisode,
    Player,
    cut_message,
    episode_novelty,
    load_players,
    play_episodes,
    render_episode,
)

HEIGHT, SIDE = 480, 640  # height of the film, and width of the traces beside the game (pixels)
SHEET, APART = 12, 16  # frames on the contact sheet, and the fewest steps between two of them


class FilmSettings(NamedTuple):
    """The settings of a film.

    Attributes:
      episodes: the number of episodes to play; the best one is filmed.
      greedy: take the most probable action instead of sampling one.
      seed: the seed of the environments.
      agent: the seed of the run whose agent plays; -1: the first.
      steps: the number of steps to film from the start of the episode; 0: all.
      rate: agent steps per second.
      out: the directory of the files.
      trust: the code that the run's configuration may name, see `load_players`.
      max_steps: the longest episode; longer ones are cut.
    """

    episodes: int
    greedy: bool
    seed: int
    agent: int
    steps: int
    rate: int
    out: Path
    trust: tuple[str, ...]
    max_steps: int


def best_episode(episodes: list[PlayedEpisode]) -> int:
    """Return the index of the episode with the highest return.

    Ties are decided by the score, then by the length.
    """
    key = lambda e: (e.reward.sum(), e.score.sum(), len(e.action))
    return max(range(len(episodes)), key=lambda i: key(episodes[i]))


def draw_traces(
    episode: PlayedEpisode, novelty: np.ndarray, names: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Draw the novelty, the values and the score of an episode over its first M steps.

    Args:
      episode: the episode.
      novelty: the signal of these steps, float32[M].
      names: of the value heads.

    Returns:
      The picture, uint8[HEIGHT, SIDE, 3], and the column of each step in it, int[M].
    """
    figure, axes = make_panels(3, 1, SIDE / 100, HEIGHT / 100, sharex=True)
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


def film_frames(
    pictures: Iterator[np.ndarray], side: np.ndarray, columns: np.ndarray
) -> Iterator[np.ndarray]:
    """Yield the frames of the film, uint8[HEIGHT, *, 3]: the game, and the traces beside it.

    Args:
      pictures: images of the game, one for each step.
      side: the picture of the traces, uint8[HEIGHT, SIDE, 3].
      columns: the column of each step in it, at which a line marks the current step.
    """
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
    """Write an mp4 file.

    Args:
      path: of the file.
      frames: the frames, uint8[H, W, 3], all of the same size.
      rate: frames per second.
      report: called with the number of frames written so far.

    Returns:
      The number of frames.

    Raises:
      OSError: the file cannot be written completely.
    """
    writer, written = None, 0
    new = path.with_name(f".new-{path.name}")  # renamed when it is complete
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
            raise OSError(f"{path} could not be written completely: is the disk full?")
        new.replace(path)
    finally:
        new.unlink(missing_ok=True)
    return written


def most_novel_steps(novelty: np.ndarray, count: int = SHEET, apart: int = APART) -> np.ndarray:
    """Return the steps of the highest novelty, in order of time.

    Args:
      novelty: the signal of each step.
      count: the largest number of steps to return.
      apart: the smallest distance between two of the returned steps.

    >>> most_novel_steps(np.array([0.0, 5.0, 4.0, 0.0, 3.0]), count=2, apart=2).tolist()
    [1, 4]
    """
    chosen: list[int] = []
    for step in np.argsort(-novelty, kind="stable").tolist():
        if all(abs(step - other) >= apart for other in chosen):
            chosen.append(step)
        if len(chosen) == count:
            break
    return np.array(sorted(chosen))


def draw_contact_sheet(pictures: dict[int, np.ndarray], novelty: np.ndarray, out: Path) -> Path:
    """Draw the most novel frames with their steps and their signal.

    Args:
      pictures: the images of the game, by step.
      novelty: the signal of each step.
      out: the path of the PNG, without suffix.

    Returns:
      The path of the PNG.
    """
    height, width = next(iter(pictures.values())).shape[:2]
    rows = -(-len(pictures) // 4)
    figure, axes = make_panels(rows, 4, 8.4, rows * (2.1 * height / width + 0.3))
    for one in axes.flat:
        one.axis("off")
    for one, (step, picture) in zip(axes.flat, pictures.items(), strict=False):
        one.imshow(picture)
        one.set_title(f"step {step:,}: {novelty[step]:.3g}", fontsize=9)
    return save_figure(figure, out.parent, out.name)


def choose_player(run: Path, settings: FilmSettings) -> Player:
    """Load the agent of a run that plays the film.

    Raises:
      ConfigError: the run has no such seed, or no agent can be loaded.
    """
    players = {player.seed: player for player in load_players(run, settings.trust)}
    player = players.get(settings.agent if settings.agent >= 0 else min(players))
    if player is None:
        raise ConfigError(f"{run}: there is no seed {settings.agent}; it has {sorted(players)}")
    return player


def record_film(run: Path, settings: FilmSettings) -> list[Path]:
    """Play episodes, and write the film and the contact sheet of the best one.

    Args:
      run: the run directory.
      settings: of the film.

    Returns:
      The files that were written.

    Raises:
      ConfigError: no agent can be loaded, or its task cannot be rendered.
      OSError: the files cannot be written.
    """
    player = choose_player(run, settings)
    with ProgressBars() as bars:
        played = play_episodes(
            player,
            settings.episodes,
            settings.greedy,
            settings.seed,
            True,
            lambda t, n: bars.update("playing", n, settings.episodes, f"episodes, step {t:,}"),
            settings.max_steps,
        )
        episode = played[best_episode(played)]
        signal = episode_novelty(player, episode)
        length = min(settings.steps or len(signal), len(signal))
        signal = signal[:length]
        heads = ["external", "intrinsic"][: episode.value.shape[1]]
        side, columns = draw_traces(episode, signal, heads)
        settings.out.mkdir(parents=True, exist_ok=True)
        name = f"seed-{player.seed}-iteration-{player.iteration}"
        novel = set(most_novel_steps(signal).tolist())
        shown: dict[int, np.ndarray] = {}

        def keep_novel() -> Iterator[np.ndarray]:
            for step, picture in enumerate(render_episode(player, episode)):
                if step in novel:
                    shown[step] = picture.copy()
                yield picture

        film = settings.out / f"{name}.mp4"
        frames = film_frames(keep_novel(), side, columns)
        write_film(film, frames, settings.rate, partial(bars.update, "filming", total=length))
        sheet = draw_contact_sheet(shown, signal, settings.out / f"{name}-most-novel")
    if note := cut_message(played, settings.max_steps):
        print(note)
    print(
        f"the best of {len(played)}, {sum(one.complete for one in played)} complete: return "
        f"{episode.reward.sum():g}, score {episode.score.sum():g}, {len(episode.action):,} steps"
        f"{'' if episode.complete else ', cut'}"
    )
    return [film, sheet]
