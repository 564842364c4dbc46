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

from experiments.arguments import TRUST, command
from experiments.options import ConfigError, option
from experiments.process import before_jax

QUARTILES = ("Q25", "Q50", "Q75", "Q95")
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
    trust: str | None = option(None, TRUST)


def check(runs: list[Path], options: Options) -> None:
    """Raise ConfigError where these runs cannot be looked at together."""
    from experiments.finished import read_run
    from experiments.stored import CONFIG

    if not runs:
        raise ConfigError("say which runs: python -m experiments.analyze RUN_DIR...")
    envs = []
    for run in runs:
        if not (run / CONFIG).is_file():
            raise ConfigError(f"{run}: there is no run (no {CONFIG})")
        try:
            envs.append(read_run(run).config.env)
        except ValueError as error:
            raise ConfigError(f"{run}: {error}") from None
    ids = {env.id for env in envs}
    if len(ids) > 1:
        raise ConfigError(f"these runs are of different environments: {', '.join(sorted(ids))}")
    if any((env.options, env.stack) != (envs[0].options, envs[0].stack) for env in envs):
        raise ConfigError("these runs see their environment differently: env.options or env.stack")
    if options.trajectory:
        from experiments.trajectory import conditions

        seen = {**envs[0].options, "repeat_action_probability": 0.0}
        if envs[0].id != conditions().id or seen != conditions().options:
            raise ConfigError(f"trajectory: it is of env=MontezumaRevenge, not of {envs[0].id}")
    if options.agent is not None and Path(options.agent) not in runs:
        raise ConfigError(f"agent={options.agent}: it is none of the runs given")


def returns_of(run: Path) -> dict[int, np.ndarray]:
    """The external returns of the training episodes, by seed."""
    from experiments.finished import read_run

    return {seed.seed: seed.episodes["ext_return"] for seed in read_run(run).seeds}


def best_of(player_returns: dict[Any, np.ndarray]) -> Any:
    """The key with the highest return over its last hundred episodes."""
    last = lambda key: float(np.mean(player_returns[key][-100:]))
    there = [key for key in player_returns if len(player_returns[key])]
    return max(there, key=last) if there else next(iter(player_returns))


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


def table_of(players: list[Any], names: list[str], most: list[float], seen: Any) -> Any:
    """Tables 5.9 and 5.10: encoder and torso of every run, and the thesis' rows.

    Args:
      players, names: the agents.
      most: the highest external return that each had in training.
      seen: the states, the encoders' features and the torsos' by name.
    """
    from experiments.geometry import COMPARED, figures
    from experiments.page import Table
    from experiments.style import label

    states, encoded, torsos = seen
    rows = []
    for player, name, highest in zip(players, names, most, strict=True):
        for kind, found in (("encoder", encoded.get(name)), ("policy torso", torsos[name])):
            if found is not None:
                own = figures(found, states.follows)
                rows.append(row_of(f"{label(name)}, {kind}", own, highest))
        theirs = thesis_row(player.config.env.name, player.config.algo.name)
        if theirs is not None:
            rows.append(theirs)
    head = ["features", "max external return", "‖z_t+1 - z_t‖", "‖z‖", *QUARTILES, "rank"]
    count = min(COMPARED, len(states.frames))
    caption = f"Norms and eigenvalues of the first {count:,} states, the rank of all"
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

    players, most, last = [], [], []
    with Bars() as bars:
        for run in bars.over("reading agents", runs):
            agents, returns = load(run, options.trust), returns_of(run)
            best = best_of(returns)
            players.append(next(player for player in agents if player.seed == best))
            most.append(float(returns[best].max()) if len(returns[best]) else float("nan"))
            last.append(returns[best])
        names = names_of(players)
        out = Path(options.out)
        out.mkdir(parents=True, exist_ok=True)
        if options.trajectory:
            bars.to("replaying the trajectory", 0, 1)
            states, origin = recorded(options.states), "the recorded trajectory"
            bars.to("replaying the trajectory", 1, 1)
        else:
            best_run = runs[best_of(dict(enumerate(last)))]
            chosen = Path(options.agent) if options.agent else best_run
            origin = f"the agent of {chosen}, seed {players[runs.index(chosen)].seed}"
            report = partial(bars.to, "collecting states", total=options.states)
            states = collected(players[runs.index(chosen)], options.states, options.seed, report)
        encoded, torsos, algos = {}, {}, {}
        for name, player in bars.over("encoding", list(zip(names, players, strict=True))):
            found = features(player, states)
            if found is not None:
                encoded[name] = found
            torsos[name] = torso(player, states)
            if not all(np.isfinite(z).all() for z in (torsos[name], encoded.get(name, 0))):
                raise ConfigError(f"{name}: its features are not finite")
            algos[name] = player.config.algo.name
        looked_at = encoded or torsos
        pictures = [
            (draw.distances(states.frames, looked_at, out), "Pairwise distances (Fig. 5.7)"),
            (draw.eigenvalues(looked_at, algos, out), "Eigenvalues (Fig. 5.9, 5.10)"),
        ]
        tsne = draw.tsne(looked_at, states.room, options.seed, out, bars)
        pictures.insert(1, (tsne, "t-SNE of the features (Fig. 5.8)"))
    table = table_of(players, names, most, (states, encoded, torsos))
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


def work(runs: list[Path], options: Options) -> None:
    """Write the page."""
    check(runs, options)
    print(f"page: {analyze(runs, options).resolve()}")


def main(arguments: list[str]) -> int:
    """The command."""
    return command(str(__doc__), Options, work, arguments)


if __name__ == "__main__":
    before_jax()
    sys.exit(main(sys.argv[1:]))
