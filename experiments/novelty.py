"""python -m experiments.novelty env=MontezumaRevenge: novelty detection with no agent (Fig. 5.11).

Modules go along one long trajectory (`experiments.trajectory`), 2,700 states in order. At every
fourth step n each takes one gradient step on 128 pairs of the past, m < n (32 runs of four, as in
the thesis' minibatches); at every 32nd its signal is read on four windows: the past, the near
future n < m < n + 128, the far future m > n, and anywhere. Seven modules take about an hour on two
cores; each is written when it is done, and the same command goes on where it was.
"""

import json
import sys
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.arguments import command
from experiments.config import load
from experiments.directory import replace
from experiments.options import ConfigError, option
from experiments.process import before_jax

ALGORITHMS = "rnd,snd_v,snd_std,snd_vic,snd_vinv,icm,sp"
ABOUT = {
    "past": "past, m < n",
    "near": "near future, n < m < n + 128",
    "far": "far future, m > n",
    "random": "any state",
}
COLOURS = {"past": "#7F7F7F", "near": "#D55E00", "far": "#0072B2", "random": "#009E73"}
PEAKS = 5  # that are shown


@dataclass(frozen=True)
class Options:
    """What can be chosen."""

    env: str = option("MontezumaRevenge", "the game", choices=("MontezumaRevenge",))
    algos: str = option(ALGORITHMS, "modules, by name")
    out: str = option("novelty", "where figures and numbers go")
    train_every: int = option(4, "states between gradient steps", low=4)
    read_every: int = option(32, "states between readings", low=1)
    states: int = option(2700, "of the trajectory, from its start", low=300, high=2700)
    seed: int = option(0, "of the weights and the draws", low=0, high=2**31 - 1)


def names_of(options: Options) -> list[str]:
    """The modules.

    Raises:
      ConfigError: one does not exist, or has no signal; the steps do not fit.
    """
    if options.read_every % options.train_every:
        raise ConfigError(f"read_every={options.read_every}: must be a multiple of train_every")
    names = [name.strip() for name in options.algos.split(",")]
    for name in names:
        if load(["env=MontezumaRevenge", f"algo={name}"]).algo.name == "ppo":
            raise ConfigError("algos=ppo: it has no novelty signal")
    return names


def settings(options: Options, name: str, digest: str) -> dict[str, Any]:
    """What makes one module's study another."""
    kept = {k: v for k, v in asdict(options).items() if k not in ("algos", "out")}
    return kept | {"algo": name, "trajectory": digest}


def done(path: Path, wanted: dict[str, Any]) -> dict[str, Any] | None:
    """A module's study, if it is there and was made with these settings."""
    try:
        stored = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    there = isinstance(stored, dict) and stored.get("settings") == wanted
    return stored if there else None


def studies(options: Options, walk: Any, out: Path) -> dict[str, dict[str, Any]]:
    """Every module's study, from the disk or made now."""

    from experiments.progress import Bars
    from experiments.study import WINDOWS, study
    from experiments.trajectory import digest

    found = {}
    total = len(walk.action)
    with Bars() as bars:
        for name in names_of(options):
            path = out / f"{name}.json"
            wanted = settings(options, name, digest(walk))
            report = partial(bars.to, name, total=total)
            report(0)
            stored = done(path, wanted)
            if stored is None:
                where, means = study(
                    name,
                    walk,
                    options.train_every,
                    options.read_every,
                    options.seed,
                    report,
                )
                curves = {w: means[:, i].tolist() for i, w in enumerate(WINDOWS)}
                stored = {"settings": wanted, "n": where.tolist()} | curves
                replace(path, json.dumps(stored) + "\n")
            report(total)
            found[name] = stored
    return found


def peaks(n: list[int], near: list[float]) -> np.ndarray:
    """The steps at which the near future was most novel, in order: where its logarithm peaks."""
    from scipy.signal import find_peaks

    where, how = find_peaks(np.log(near), prominence=0.05, distance=3)
    most = where[np.argsort(how["prominences"])[::-1][:PEAKS]]
    return np.array(n)[np.sort(most)]


def draw(name: str, stored: dict[str, Any], walk: Any, out: Path) -> Path:
    """A panel of Fig. 5.11: the windows' signals along the trajectory, and the states at peaks."""
    from experiments.style import label, panels, save

    figure, axes = panels(2, 1, 8.4, 5.4, height_ratios=[3, 1.3])
    top, bottom = axes[:, 0]
    for window, about in ABOUT.items():
        top.plot(stored["n"], stored[window], color=COLOURS[window], label=about, linewidth=1.4)
    for step in first_visits(walk):
        top.axvline(step, color="#000000", alpha=0.2, linewidth=0.8, zorder=0)
    where = peaks(stored["n"], stored["near"])
    heights = np.interp(where, stored["n"], stored["near"])
    top.plot(where, heights, "o", color="red", markersize=5)
    for i, (x, y) in enumerate(zip(where, heights, strict=True)):
        top.annotate(f"{i + 1}", (x, y), textcoords="offset points", xytext=(4, 4))
    top.set_yscale("log")
    top.set_xlabel("step n of the trajectory (agent steps); lines: a room seen for the first time")
    top.set_ylabel("signal, unscaled")
    top.set_title(label(name))
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
    return save(figure, out, f"novelty-{name}")


def first_visits(walk: Any) -> list[int]:
    """The steps at which each room but the first is seen for the first time."""
    _, first = np.unique(walk.room, return_index=True)
    return sorted(int(step) + 1 for step in first)[1:]


HEAD = (
    "module",
    "far / past",
    "the same, last quarter",
    "near: last / first quarter",
    "a new room ahead",
)


def table_rows(found: dict[str, dict[str, Any]], walk: Any) -> list[list[str]]:
    """The claim in numbers, a row a module."""
    from experiments.study import WINDOWS, figures
    from experiments.style import label

    rows = []
    for name, stored in found.items():
        means = np.array([stored[window] for window in WINDOWS]).T
        numbers = figures(np.array(stored["n"]), means, first_visits(walk))
        rows.append([label(name), *(f"{value:.2f}" for value in numbers.values())])
    return rows


def work(places: list[Path], options: Options) -> None:
    """Study every module, draw, and write the page."""
    if places:
        raise ConfigError(f"'{places[0]}': write key=value")
    names_of(options)
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    from experiments.page import Section, Table, write_page
    from experiments.process import keep_compilations
    from experiments.trajectory import Walk, replayed

    keep_compilations()
    print("replaying the trajectory", flush=True)
    whole = replayed()
    cut = options.states
    walk = Walk(whole.frames[:cut], whole.action[: cut - 1], whole.room[: cut - 1])
    found = studies(options, walk, out)
    pictures = [(draw(name, stored, walk, out), name) for name, stored in found.items()]
    caption = (
        "The last column: how probably near / past is higher at a step with a new room in the "
    )
    caption += "near future than at one without (0.5 is chance)"
    table = Table(HEAD, table_rows(found, walk), caption, "novelty")
    visits = first_visits(walk)
    write_page(
        out / "index.html",
        "Novelty along a trajectory, Montezuma's Revenge",
        f"{len(walk.frames):,} states, {len(visits) + 1} rooms, each module trained on its past "
        "alone (Fig. 5.11 of the thesis). Red dots: peaks of the near future, with the state 64 "
        "steps on.",
        [Section("In numbers", tables=[table]), Section("Module by module", pictures=pictures)],
    )
    print("\n".join("  ".join(f"{cell:<26}" for cell in row) for row in [HEAD, *table.rows]))
    print(f"page: {(out / 'index.html').resolve()}")


def main(arguments: list[str]) -> int:
    """The command."""
    return command(str(__doc__), Options, work, arguments, needs_places=False)


if __name__ == "__main__":
    before_jax()
    sys.exit(main(sys.argv[1:]))
