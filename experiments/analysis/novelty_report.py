"""The page of Fig. 5.11: every module's signal along the recorded trajectory."""

import json
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..config.compose import load_config
from ..reporting.html_page import Section, Table, write_page
from ..reporting.plot_style import display_name, make_panels, save_figure
from ..system.display import ProgressBars
from ..system.errors import ConfigError
from ..system.files import write_atomically
from ..system.process import enable_compilation_cache
from .montezuma_path import Trajectory, load_committed_trajectory, trajectory_digest
from .novelty_study import WINDOWS, study_figures, study_module

ABOUT = {
    "past": "past, m < n",
    "near": "near future, n < m < n + 128",
    "far": "far future, m > n",
    "random": "any state",
}
COLOURS = {"past": "#7F7F7F", "near": "#D55E00", "far": "#0072B2", "random": "#009E73"}
PEAKS = 5  # peaks that are shown


class StudySettings(NamedTuple):
    """The settings of the studies.

    Attributes:
      env: the game.
      algos: the names of the modules.
      train_every: the number of states between gradient steps.
      read_every: the number of states between readings.
      states: the number of states of the trajectory, from its start.
      seed: the seed of the weights and the random draws.
    """

    env: str
    algos: list[str]
    train_every: int
    read_every: int
    states: int
    seed: int


def check_modules(settings: StudySettings) -> None:
    """Check the modules and the steps.

    Raises:
      ConfigError: a module does not exist or has no signal, or `read_every` is not a multiple of
        `train_every`.
    """
    if settings.read_every % settings.train_every:
        raise ConfigError(f"read_every={settings.read_every}: must be a multiple of train_every")
    for name in settings.algos:
        if load_config(["env=MontezumaRevenge", f"algo={name}"]).algo.name == "ppo":
            raise ConfigError("algos=ppo: it has no novelty signal")


def study_id(settings: StudySettings, name: str, digest: str) -> dict[str, Any]:
    """Return the settings that identify a cached study.

    Args:
      settings: the settings of all studies.
      name: the name of the module.
      digest: the digest of the trajectory.
    """
    kept = {k: v for k, v in settings._asdict().items() if k != "algos"}
    return kept | {"algo": name, "trajectory": digest}


def read_study(path: Path, wanted: dict[str, Any]) -> dict[str, Any] | None:
    """Return the cached study of a module, or None if there is none with these settings."""
    try:
        stored = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    there = isinstance(stored, dict) and stored.get("settings") == wanted
    return stored if there else None


def make_studies(settings: StudySettings, walk: Trajectory, out: Path) -> dict[str, dict[str, Any]]:
    """Return the study of every module, from the cache or made now.

    Args:
      settings: the settings of all studies.
      walk: the trajectory.
      out: the directory of the cached studies.
    """
    found = {}
    total = len(walk.action)
    with ProgressBars() as bars:
        for name in settings.algos:
            path = out / f"{name}.json"
            wanted = study_id(settings, name, trajectory_digest(walk))
            report = partial(bars.update, name, total=total)
            report(0)
            stored = read_study(path, wanted)
            if stored is None:
                where, means = study_module(
                    name,
                    walk,
                    settings.train_every,
                    settings.read_every,
                    settings.seed,
                    report,
                )
                curves = {w: means[:, i].tolist() for i, w in enumerate(WINDOWS)}
                stored = {"settings": wanted, "n": where.tolist()} | curves
                write_atomically(path, json.dumps(stored) + "\n")
            report(total)
            found[name] = stored
    return found


def find_novelty_peaks(n: list[int], near: list[float]) -> np.ndarray:
    """Return the steps, in order, where the logarithm of the near future's signal peaks."""
    from scipy.signal import find_peaks

    where, how = find_peaks(np.log(near), prominence=0.05, distance=3)
    most = where[np.argsort(how["prominences"])[::-1][:PEAKS]]
    return np.array(n)[np.sort(most)]


def draw_study(name: str, stored: dict[str, Any], walk: Trajectory, out: Path) -> Path:
    """Draw a panel of Fig. 5.11: the signal of every window, and the states at the peaks.

    Args:
      name: the name of the module.
      stored: the study of the module.
      walk: the trajectory.
      out: the directory of the picture.

    Returns:
      The path of the picture.
    """
    figure, axes = make_panels(2, 1, 8.4, 5.4, height_ratios=[3, 1.3])
    top, bottom = axes[:, 0]
    for window, about in ABOUT.items():
        top.plot(stored["n"], stored[window], color=COLOURS[window], label=about, linewidth=1.4)
    for step in first_visits(walk):
        top.axvline(step, color="#000000", alpha=0.2, linewidth=0.8, zorder=0)
    where = find_novelty_peaks(stored["n"], stored["near"])
    heights = np.interp(where, stored["n"], stored["near"])
    top.plot(where, heights, "o", color="red", markersize=5)
    for i, (x, y) in enumerate(zip(where, heights, strict=True)):
        top.annotate(f"{i + 1}", (x, y), textcoords="offset points", xytext=(4, 4))
    top.set_yscale("log")
    top.set_xlabel("step n of the trajectory (agent steps); lines: a room seen for the first time")
    top.set_ylabel("signal, unscaled")
    top.set_title(display_name(name))
    top.legend(frameon=False, fontsize=8, ncols=2)
    bottom.axis("off")
    shown = [walk.frames[min(step + 64, len(walk.frames) - 1), :, :, 0] for step in where]
    if shown:
        gap = np.full((shown[0].shape[0], 8), 255, np.uint8)
        bottom.imshow(
            np.concatenate([x for frame in shown for x in (frame, gap)], axis=1), cmap="gray"
        )
        for i, step in enumerate(where):
            bottom.text(i * 104 + 2, -4, f"{i + 1}: m = {step + 64}", fontsize=8)
    return save_figure(figure, out, f"novelty-{name}")


def first_visits(walk: Trajectory) -> list[int]:
    """Return the steps at which a new room is entered for the first time."""
    _, first = np.unique(walk.room, return_index=True)
    return sorted(int(step) + 1 for step in first)[1:]


HEAD = (
    "module",
    "far / past",
    "the same, last quarter",
    "near: last / first quarter",
    "a new room ahead",
)


def study_rows(found: dict[str, dict[str, Any]], walk: Trajectory) -> list[list[str]]:
    """Return the rows of the table: for each module, the figures of `study_figures`."""
    rows = []
    for name, stored in found.items():
        means = np.array([stored[window] for window in WINDOWS]).T
        numbers = study_figures(np.array(stored["n"]), means, first_visits(walk))
        rows.append([display_name(name), *(f"{value:.2f}" for value in numbers.values())])
    return rows


def write_novelty_page(settings: StudySettings, out: Path) -> None:
    """Study every module, draw the pictures, and write the page; cached studies are reused.

    Raises:
      ConfigError: a module does not exist or has no signal, or `read_every` is not a multiple of
        `train_every`.
    """
    check_modules(settings)
    out.mkdir(parents=True, exist_ok=True)
    enable_compilation_cache()
    print("replaying the trajectory", flush=True)
    whole = load_committed_trajectory()
    cut = settings.states
    walk = Trajectory(whole.frames[:cut], whole.action[: cut - 1], whole.room[: cut - 1])
    found = make_studies(settings, walk, out)
    pictures = [(draw_study(name, stored, walk, out), name) for name, stored in found.items()]
    caption = (
        "The last column: how probably near / past is higher at a step with a new room in the "
    )
    caption += "near future than at one without (0.5 is chance)"
    table = Table(HEAD, study_rows(found, walk), caption, "novelty")
    visits = first_visits(walk)
    write_page(
        out / "index.html",
        "Novelty along a trajectory, Montezuma's Revenge",
        f"{len(walk.frames):,} states, {len(visits) + 1} rooms, each module trained on its past "
        "alone (Fig. 5.11 of the thesis). Red dots: peaks of the near future, with the state 64 "
        "steps on.",
        [Section("In numbers", tables=[table]), Section("Module by module", pictures=pictures)],
    )
    print("\n".join("  ".join(f"{entry:<26}" for entry in row) for row in [HEAD, *table.rows]))
    print(f"page: {(out / 'index.html').resolve()}")
