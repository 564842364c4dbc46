"""python -m experiments.analyze RUN_DIR...: the feature spaces of trained modules (section 5.4).

Collects states with one agent (or takes the recorded trajectory through Montezuma's Revenge),
encodes them with the module of every run, and draws Fig. 5.7 to 5.10 with the rows of Tables 5.9
and 5.10: one page, and each part as PNG, SVG and CSV.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.arguments import read, usage
from experiments.options import ConfigError, option
from experiments.process import before_jax
from experiments.run import refuse

SPREAD_OUT = 1000  # states of the distance matrices and of t-SNE
THESIS = {"step": "l2_norm", "q25": "eigenvalue_q25", "q50": "eigenvalue_q50",
          "q75": "eigenvalue_q75", "q95": "eigenvalue_q95"}  # fmt: skip


@dataclass(frozen=True)
class Options:
    """What can be chosen."""

    states: int = option(10_000, "to collect", low=100, high=1_000_000)
    trajectory: bool = option(False, "take the recorded one instead of an agent's")
    agent: str | None = option(None, "the run whose agent collects; default: the best of them")
    seed: int = option(0, "of the environments and of t-SNE", low=0, high=2**31 - 1)
    out: str = option("analysis", "where the page goes")


def check(runs: list[Path], options: Options) -> None:
    """Raise ConfigError where these runs cannot be looked at together."""
    from experiments.finished import read_run
    from experiments.stored import CONFIG

    if not runs:
        raise ConfigError("say which runs: python -m experiments.analyze RUN_DIR...")
    envs = {}
    for run in runs:
        if not (run / CONFIG).is_file():
            raise ConfigError(f"{run}: there is no run (no {CONFIG})")
        try:
            envs[run] = read_run(run).config.env
        except ValueError as error:
            raise ConfigError(f"{run}: {error}") from None
    ids = {env.id for env in envs.values()}
    if len(ids) > 1:
        raise ConfigError(f"these runs are of different environments: {', '.join(sorted(ids))}")
    if options.trajectory and not min(ids).startswith("MontezumaRevenge"):
        raise ConfigError(f"trajectory: it is of MontezumaRevenge, these runs are of {min(ids)}")
    if options.agent is not None and Path(options.agent) not in runs:
        raise ConfigError(f"agent={options.agent}: it is none of the runs given")


def best_of(runs: list[Path]) -> Path:
    """The run with the highest external return over its last hundred episodes."""
    from experiments.finished import read_run

    def last(run: Path) -> float:
        returns = [seed.episodes["ext_return"][-100:] for seed in read_run(run).seeds]
        return max((float(x.mean()) for x in returns if len(x)), default=-np.inf)

    return max(runs, key=last)


def names_of(players: list[Any]) -> list[str]:
    """A name for each run: its algorithm, numbered where there are several."""
    algos = [player.config.algo.name for player in players]
    return [
        algo if algos.count(algo) == 1 else f"{algo} #{algos[: i + 1].count(algo)}"
        for i, algo in enumerate(algos)
    ]


def draw_distances(states: Any, spaces: dict[str, np.ndarray], out: Path) -> Path:
    """Fig. 5.7: pairwise distances of states and of their features, each over its own range."""
    from experiments.geometry import distances
    from experiments.style import label, panels, save

    shown = {"states": states.frames} | spaces
    columns = min(3, len(shown))
    rows = -(-len(shown) // columns)
    figure, axes = panels(rows, columns, 3.4 * columns, 3.2 * rows)
    for one in axes.flat[len(shown) :]:
        one.axis("off")
    for one, (name, x) in zip(axes.flat, shown.items(), strict=False):
        found = distances(x[:SPREAD_OUT] / 255 if x.dtype == np.uint8 else x[:SPREAD_OUT])
        image = one.imshow(found, cmap="coolwarm", interpolation="nearest")
        one.set_title(label(name))
        one.set_xlabel("state, in order")
        figure.colorbar(image, ax=one, shrink=0.8, label="L2 distance")
    return save(figure, out, "distances")


def draw_tsne(states: Any, spaces: dict[str, np.ndarray], seed: int, out: Path) -> Path:
    """Fig. 5.8: t-SNE of the features, coloured by room (by order where there are no rooms)."""
    from rich.progress import track
    from sklearn.manifold import TSNE

    from experiments.style import label, panels, plt, save

    columns = min(3, len(spaces))
    rows = -(-len(spaces) // columns)
    figure, axes = panels(rows, columns, 3.4 * columns, 3.2 * rows)
    for one in axes.flat:
        one.axis("off")
    for i, (name, z) in track(list(enumerate(spaces.items())), "t-SNE"):
        one, z = axes.flat[i], z[:SPREAD_OUT]
        perplexity = min(30, (len(z) - 1) // 3)
        points = TSNE(random_state=seed, perplexity=perplexity, init="pca").fit_transform(z)
        if states.room is None:
            dots = one.scatter(*points.T, c=np.arange(len(z)), s=5, cmap="viridis")
            if i == 0:
                figure.colorbar(dots, ax=one, label="state, in order")
        else:
            for k, room in enumerate(np.unique(states.room[: len(z)])):
                own = states.room[: len(z)] == room
                colour = plt.get_cmap("tab20")(k % 20)
                one.scatter(*points[own].T, s=5, color=colour, label=f"room {room}")
            if i == 0:
                one.legend(fontsize=6, markerscale=2, loc="upper left", frameon=False)
        one.set_title(label(name))
    return save(figure, out, "tsne")


def draw_eigenvalues(spaces: dict[str, np.ndarray], algos: dict[str, str], out: Path) -> Path:
    """Fig. 5.9 and 5.10: the eigenvalues in descending order, on a logarithmic axis."""
    from experiments.geometry import COMPARED, eigenvalues
    from experiments.style import label, panels, save, style

    figure, ((axes,),) = panels(1, 1)
    for name, z in spaces.items():
        spectrum = eigenvalues(z[:COMPARED])
        shown = np.maximum(spectrum, 1e-12 * spectrum[0])
        axes.plot(shown, label=label(name), linewidth=1.8, **style(algos[name]))
    axes.set_yscale("log")
    axes.set_xlabel("index, in descending order")
    axes.set_ylabel(f"eigenvalue ({min(COMPARED, len(z)):,} states)")
    axes.legend(frameon=False)
    return save(figure, out, "eigenvalues")


def row_of(name: str, found: dict[str, float], most: float) -> list[str]:
    """Our row of the table."""
    return [
        name,
        "" if np.isnan(most) else f"{most:g}",
        f"{found['step_mean']:.2f} ± {found['step_std']:.2f}",
        f"{found['norm_mean']:.2f} ± {found['norm_std']:.2f}",
        *(f"{found[q]:.4g}" for q in ("q25", "q50", "q75", "q95")),
        f"{found['rank']} of {found['d']}",
    ]


def thesis_row(env: str, algo: str) -> list[str] | None:
    """The thesis' row of this cell, if it has one."""
    from experiments.style import label
    from experiments.tables import published, thesis

    for table in ("5.9", "5.10"):
        known = thesis(table)
        if (env, algo, "l2_norm") in known:
            of = lambda quantity, known=known: published(known[env, algo, quantity])
            values = [of(THESIS[key]) for key in ("q25", "q50", "q75", "q95")]
            most = of("max_external_reward")
            return [f"{label(algo)}, thesis", most, of("l2_norm"), "", *values, ""]
    return None


def table_of(
    players: list[Any], names: list[str], runs: list[Path], spaces: Any, torsos: Any, states: Any
) -> Any:
    """Tables 5.9 and 5.10: encoder and torso of every run, and the thesis' rows."""
    from experiments.finished import read_run
    from experiments.geometry import figures
    from experiments.page import Table
    from experiments.style import label

    rows = []
    for player, name, run in zip(players, names, runs, strict=True):
        returns = [seed.episodes["ext_return"] for seed in read_run(run).seeds]
        most = max((float(x.max()) for x in returns if len(x)), default=float("nan"))
        for kind, found in (("encoder", spaces.get(name)), ("policy torso", torsos[name])):
            if found is not None:
                own = figures(found, states.follows)
                rows.append(row_of(f"{label(name)}, {kind}", own, most))
        theirs = thesis_row(player.config.env.name, player.config.algo.name)
        if theirs is not None:
            rows.append(theirs)
    head = ["features", "max external return", "‖z_t+1 - z_t‖", "‖z‖", "Q25", "Q50", "Q75", "Q95",
            "rank"]  # fmt: skip
    caption = f"Eigenvalues of the first {min(1000, len(states.frames)):,} states"
    return Table(head, rows, caption, "geometry")


def analyze(runs: list[Path], options: Options) -> Path:
    """Collect, encode, draw: the page.

    Raises:
      ConfigError: a run has no agent to read back.
    """
    from rich.progress import track

    from experiments.page import Section, write_page
    from experiments.player import load
    from experiments.states import collected, features, recorded, torso

    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    players = [load(run) for run in track(runs, "reading agents")]
    names = names_of(players)
    chosen = Path(options.agent) if options.agent else best_of(runs)
    if options.trajectory:
        print("replaying the trajectory", flush=True)
        states, origin = recorded(options.states), "the recorded trajectory"
    else:
        player = players[runs.index(chosen)]
        origin = f"the agent of {chosen}"
        say = lambda count: print(f"collected {count:,} of {options.states:,} states", flush=True)
        states = collected(player, options.states, options.seed, say)
    spaces, torsos = {}, {}
    for player, name in track(list(zip(players, names, strict=True)), "encoding"):
        encoded = features(player, states)
        if encoded is not None:
            spaces[name] = encoded
        torsos[name] = torso(player, states)
    algos = {name: player.config.algo.name for player, name in zip(players, names, strict=True)}
    looked_at = spaces or torsos
    print("drawing", flush=True)
    pictures = [
        (draw_distances(states, looked_at, out), "Pairwise distances (Fig. 5.7)"),
        (draw_tsne(states, looked_at, options.seed, out), "t-SNE of the features (Fig. 5.8)"),
        (draw_eigenvalues(looked_at, algos, out), "Eigenvalues (Fig. 5.9, 5.10)"),
    ]
    table = table_of(players, names, runs, spaces, torsos, states)
    page = out / "index.html"
    rooms = "" if states.room is None else f" in {len(np.unique(states.room))} rooms"
    write_page(
        page,
        f"Feature spaces, {players[0].config.env.name}",
        f"{len(states.frames):,} states{rooms} of {origin}; first {SPREAD_OUT:,} in the pictures.",
        [Section("Geometry", tables=[table]), Section("Pictures", pictures=pictures)],
    )
    return page


def main(arguments: list[str]) -> int:
    """Write the page."""
    if not arguments or "--help" in arguments or "-h" in arguments:
        print(usage(str(__doc__), Options))
        return 0 if arguments else 2
    try:
        runs, options = read(arguments, Options)
        check(runs, options)
        print(f"page: {analyze(runs, options).resolve()}")
    except (ConfigError, OSError) as error:
        return refuse(error)
    return 0


if __name__ == "__main__":
    before_jax()
    sys.exit(main(sys.argv[1:]))
