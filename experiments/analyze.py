"""python -m experiments.analyze RUN_DIR...: the feature spaces of trained modules (section 5.4).

Collects states with one agent (or takes the recorded trajectory through Montezuma's Revenge),
encodes them with the module of every run, and draws Fig. 5.7 to 5.10 with the rows of Tables 5.9
and 5.10: one page, and each part as PNG, SVG and CSV.
"""

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.arguments import read, usage
from experiments.options import ConfigError, option
from experiments.process import before_jax
from experiments.run import refuse

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
    from experiments.geometry import COMPARED, figures
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
    caption = f"Eigenvalues of the first {min(COMPARED, len(states.frames)):,} states"
    return Table(head, rows, caption, "geometry")


def analyze(runs: list[Path], options: Options) -> Path:
    """Collect, encode, draw: the page.

    Raises:
      ConfigError: a run has no agent to read back.
    """
    from experiments import spaces as draw
    from experiments.page import Section, write_page
    from experiments.player import load
    from experiments.progress import Bars
    from experiments.states import collected, features, recorded, torso

    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    with Bars() as bars:
        players = [load(run) for run in bars.over("reading agents", runs)]
        names = names_of(players)
        if options.trajectory:
            bars.to("replaying the trajectory", 0, 1)
            states, origin = recorded(options.states), "the recorded trajectory"
            bars.to("replaying the trajectory", 1, 1)
        else:
            chosen = Path(options.agent) if options.agent else best_of(runs)
            origin = f"the agent of {chosen}"
            report = partial(bars.to, "collecting states", total=options.states)
            states = collected(players[runs.index(chosen)], options.states, options.seed, report)
        encoded, torsos, algos = {}, {}, {}
        for name, player in bars.over("encoding", list(zip(names, players, strict=True))):
            found = features(player, states)
            if found is not None:
                encoded[name] = found
            torsos[name] = torso(player, states)
            algos[name] = player.config.algo.name
        looked_at = encoded or torsos
        pictures = [
            (draw.distances(states.frames, looked_at, out), "Pairwise distances (Fig. 5.7)"),
            (draw.eigenvalues(looked_at, algos, out), "Eigenvalues (Fig. 5.9, 5.10)"),
        ]
        tsne = draw.tsne(looked_at, states.room, options.seed, out, bars)
        pictures.insert(1, (tsne, "t-SNE of the features (Fig. 5.8)"))
    table = table_of(players, names, runs, encoded, torsos, states)
    page = out / "index.html"
    rooms = "" if states.room is None else f" in {len(np.unique(states.room))} rooms"
    write_page(
        page,
        f"Feature spaces, {players[0].config.env.name}",
        f"{len(states.frames):,} states{rooms} of {origin}; {draw.SHOWN:,} of them, evenly spaced, "
        "in the first two pictures.",
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
