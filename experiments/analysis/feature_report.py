"""The page about feature spaces: Fig. 5.7 to 5.10 with the rows of Tables 5.9 and 5.10."""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..config.saved import CONFIG
from ..evaluation.players import Player, load_players
from ..reporting.html_page import Section, Table, write_page
from ..reporting.plot_style import display_name
from ..reporting.thesis_tables import format_published, thesis_numbers
from ..storage.read_runs import read_run
from ..system.display import ProgressBars
from ..system.errors import ConfigError
from .feature_geometry import COMPARED, geometry_figures
from .feature_plots import SHOWN, plot_distances, plot_eigenvalues, plot_tsne
from .montezuma_path import deterministic_env_config
from .state_dataset import (
    States,
    collect_states,
    encode_states,
    policy_torso_features,
    trajectory_states,
)

QUARTILES = ("Q25", "Q50", "Q75", "Q95")
THESIS = {"step": "l2_norm", "q25": "eigenvalue_q25", "q50": "eigenvalue_q50",
          "q75": "eigenvalue_q75", "q95": "eigenvalue_q95"}  # fmt: skip


def check_runs(runs: list[Path], trajectory: bool, agent: Path | None) -> None:
    """Check that the runs can be compared.

    Args:
      runs: the directories of the runs.
      trajectory: whether the states come from the recorded trajectory.
      agent: the run whose agent collects states; None for the best.

    Raises:
      ConfigError: no runs are given, a directory holds no run, the runs have different
        environments, the trajectory is of another environment, or `agent` is not one of the runs.
    """
    if not runs:
        raise ConfigError("give the runs: sndjax analyze RUN_DIR...")
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
    if trajectory:
        seen = {**envs[0].options, "repeat_action_probability": 0.0}
        recorded = deterministic_env_config()
        if envs[0].id != recorded.id or seen != recorded.options:
            raise ConfigError(f"trajectory: it is of env=MontezumaRevenge, not of {envs[0].id}")
    if agent is not None and agent not in runs:
        raise ConfigError(f"agent={agent}: it is not one of the given runs")


def training_returns(run: Path) -> dict[int, np.ndarray]:
    """Return the external returns of a run's training episodes, by seed."""
    return {seed.seed: seed.episodes["ext_return"] for seed in read_run(run).seeds}


def best_key(returns: dict[Any, np.ndarray]) -> Any:
    """Return the key with the highest mean return over its last hundred episodes."""
    last = lambda key: float(np.mean(returns[key][-100:]))
    there = [key for key in returns if len(returns[key])]
    return max(there, key=last) if there else next(iter(returns))


def run_names(players: list[Player]) -> list[str]:
    """Return a name for each run: its algorithm, numbered if several runs have the same."""
    algos = [player.config.algo.name for player in players]
    return [
        algo if algos.count(algo) == 1 else f"{algo} #{algos[: i + 1].count(algo)}"
        for i, algo in enumerate(algos)
    ]


def table_row(name: str, found: dict[str, float], most: float) -> list[str]:
    """Format our row of the table.

    Args:
      name: the name of the run and the network.
      found: the figures that `geometry_figures` returns.
      most: the highest external return in training, or NaN.
    """
    return [
        name,
        "" if np.isnan(most) else f"{most:g}",
        f"{found['step_mean']:.2f} ± {found['step_std']:.2f}",
        f"{found['norm_mean']:.2f} ± {found['norm_std']:.2f}",
        *(f"{found[q]:.4g}" for q in ("q25", "q50", "q75", "q95")),
        f"{found['rank']} of {found['d']}",
    ]


def thesis_row(env: str, algo: str) -> list[str] | None:
    """Return the thesis' row for an environment and an algorithm, or None if there is none."""
    for table in ("5.9", "5.10"):
        known = thesis_numbers(table)
        if (env, algo, "l2_norm") in known:
            of = lambda quantity, known=known: format_published(known[env, algo, quantity])
            values = [of(THESIS[key]) for key in ("q25", "q50", "q75", "q95")]
            most = of("max_external_reward")
            return [f"{display_name(algo)}, thesis", most, of("l2_norm"), "", *values, ""]
    return None


class Encoded(NamedTuple):
    """States, and their features in the networks of every run.

    Attributes:
      states: the states, in order.
      encoders: the features of every run's encoder, float32[M, d], by the run's name; the baseline
        has none.
      torsos: the features of every run's policy torso, float32[M, d].
    """

    states: States
    encoders: dict[str, np.ndarray]
    torsos: dict[str, np.ndarray]


def geometry_table(
    players: list[Player], names: list[str], most: list[float], encoded: Encoded
) -> Table:
    """Make Tables 5.9 and 5.10: encoder and torso of every run, and the thesis' rows.

    Args:
      players: the agents.
      names: the names of their runs.
      most: the highest external return of each agent in training.
      encoded: the states and their features.
    """
    rows = []
    for player, name, highest in zip(players, names, most, strict=True):
        spaces = (("encoder", encoded.encoders.get(name)), ("policy torso", encoded.torsos[name]))
        for kind, z in spaces:
            if z is not None:
                own = geometry_figures(z, encoded.states.follows)
                rows.append(table_row(f"{display_name(name)}, {kind}", own, highest))
        theirs = thesis_row(player.config.env.name, player.config.algo.name)
        if theirs is not None:
            rows.append(theirs)
    head = ["features", "max external return", "‖z_t+1 - z_t‖", "‖z‖", *QUARTILES, "rank"]
    count = min(COMPARED, len(encoded.states.frames))
    caption = f"Norms and eigenvalues of the first {count:,} states, the rank of all"
    return Table(head, rows, caption, "geometry")


def encode_all(
    players: list[Player], names: list[str], states: States, bars: ProgressBars
) -> Encoded:
    """Encode the states with every run's networks.

    Args:
      players: the agents.
      names: the names of their runs.
      states: the states to encode.
      bars: the progress display.

    Raises:
      ConfigError: a module has no features, or some features are not finite.
    """
    encoders, torsos = {}, {}
    for name, player in bars.track("encoding", list(zip(names, players, strict=True))):
        z = encode_states(player, states)
        if z is not None:
            encoders[name] = z
        torsos[name] = policy_torso_features(player, states)
        if not all(np.isfinite(z).all() for z in (torsos[name], encoders.get(name, 0))):
            raise ConfigError(f"{name}: its features are not finite")
    return Encoded(states, encoders, torsos)


def draw_pictures(
    encoded: Encoded, algos: dict[str, str], seed: int, out: Path, bars: ProgressBars
) -> list[tuple[Path, str]]:
    """Draw Fig. 5.7 to 5.10, and return the path and the caption of each picture.

    Args:
      encoded: the states and their features.
      algos: the algorithm of every run, by the run's name.
      seed: the seed of t-SNE.
      out: the directory of the pictures.
      bars: the progress display.
    """
    states, shown = encoded.states, encoded.encoders or encoded.torsos
    return [
        (plot_distances(states.frames, shown, out), "Pairwise distances (Fig. 5.7)"),
        (plot_tsne(shown, states.room, seed, out, bars), "t-SNE of the features (Fig. 5.8)"),
        (plot_eigenvalues(shown, algos, out), "Eigenvalues (Fig. 5.9, 5.10)"),
    ]


def write_feature_report(
    runs: list[Path],
    count: int,
    trajectory: bool,
    agent: Path | None,
    seed: int,
    out: Path,
    trust: tuple[str, ...],
) -> Path:
    """Collect states, encode them, draw the pictures, and return the path of the page.

    Args:
      runs: the directories of the runs.
      count: the number of states to collect.
      trajectory: whether to use the states of the recorded trajectory instead.
      agent: the run whose agent collects states; None for the best.
      seed: the seed of the environments and of t-SNE.
      out: the directory of the page.
      trust: the code that the runs' configurations may name, see `load_players`.

    Raises:
      ConfigError: the agents of a run cannot be loaded, or features are missing or not finite.
    """
    players, most, last = [], [], []
    out.mkdir(parents=True, exist_ok=True)
    with ProgressBars() as bars:
        for run in bars.track("reading agents", runs):
            agents, returns = load_players(run, trust), training_returns(run)
            best = best_key(returns)
            players.append(next(player for player in agents if player.seed == best))
            most.append(float(returns[best].max()) if len(returns[best]) else float("nan"))
            last.append(returns[best])
        names = run_names(players)
        if trajectory:
            bars.update("replaying the trajectory", 0, 1)
            states, origin = trajectory_states(count), "the recorded trajectory"
            bars.update("replaying the trajectory", 1, 1)
        else:
            chosen = agent or runs[best_key(dict(enumerate(last)))]
            player = players[runs.index(chosen)]
            origin = f"the agent of {chosen}, seed {player.seed}"
            report = partial(bars.update, "collecting states", total=count)
            states = collect_states(player, count, seed, report)
        encoded = encode_all(players, names, states, bars)
        algos = {name: player.config.algo.name for name, player in zip(names, players, strict=True)}
        pictures = draw_pictures(encoded, algos, seed, out, bars)
    table = geometry_table(players, names, most, encoded)
    page = out / "index.html"
    rooms = "" if states.room is None else f" in {len(np.unique(states.room))} rooms"
    write_page(
        page,
        f"Feature spaces, {players[0].config.env.name}",
        f"{len(states.frames):,} states{rooms} of {origin}; {SHOWN:,} of them, evenly spaced, "
        "in the first two pictures.",
        [Section("Geometry", tables=[table]), Section("Pictures", pictures=pictures)],
    )
    return page
