"""Why a method explores or does not: its novelty and its features on every place of a level.

The places of a level are a ground truth: which were visited, and how many steps lie between them.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped
from scipy import stats

import sndjax
from sndjax.acting import scale_observations

from ..config.compose import load_config
from ..config.schema import Config
from ..environments.jax_environments import make_environment
from ..reporting.seed_statistics import probability_of_improvement
from ..system.errors import ConfigError
from ..training.experiment import build_experiment
from .places import make_expand, steps_between, take, walk_level
from .population import Population
from .protocol import Method, Protocol, Task
from .rows import row_path, write_json
from .tuning import TOGETHER, Setting, run_arguments

READINGS = 10  # of a training
SOURCES = 24  # places from which the steps to all others are counted
REDRAWS = 8  # of what a distractor adds
Frames = Shaped[Array, "R 2 M *frame"]  # of every place, and of what follows an action there


class Ground(NamedTuple):
    """What is known of a level's places, and what a module sees of them.

    Attributes:
      places: their numbers, int[M].
      sources: indices of some, int[K].
      steps: from these to all, float[K, M]; inf: no way.
      frames: see `Frames`; the draws differ only in what a distractor adds.
      action: what is done in each, int[M].
    """

    places: np.ndarray
    sources: np.ndarray
    steps: np.ndarray
    frames: Frames
    action: Int[Array, " M"]


def look_twice(env: sndjax.JaxEnvironment, key: Any) -> Any:
    """Return the first observation of an episode and the one after it, [2, ...].

    Args:
      env: the environment.
      key: of its draws.
    """
    state, first = env.reset(key)
    _, second, *_ = env.step(jax.random.fold_in(key, 1), state, jnp.int32(0))
    return jnp.stack([first, second])


def find_ground(config: Config, read: Any) -> Ground:
    """Walk through the level of a configuration, without its distractor.

    Args:
      config: of an agent.
      read: the reader of observations.

    Raises:
      ConfigError: the level is too large or has no places, or its distractor is within images.
    """
    options = {key: value for key, value in config.env.options.items() if key != "distractor"}
    plain = make_environment(replace(config.env, options=options))
    if plain.place is None:
        raise ConfigError(f"{config.env.id} has no places")
    walk = walk_level(plain)
    random = np.random.default_rng(0)
    count = len(walk.places)
    sources = random.choice(count, min(SOURCES, count), replace=False)
    action = random.integers(0, plain.num_actions, count)
    after = make_expand(plain)(walk.points).point.observation
    following = np.asarray(after)[np.arange(count), action]
    seen = np.stack([walk.points.observation, following])
    env = make_environment(config.env)
    keys = jax.random.split(jax.random.key(3), REDRAWS)
    drawn = np.asarray(jax.vmap(lambda key: look_twice(env, key))(keys))
    added = drawn[:, :, seen.shape[2] :]
    if "distractor" in config.env.options and not added.shape[2]:
        raise ConfigError(f"{config.env.name}: a distractor within images cannot be drawn again")
    tail = np.broadcast_to(added[:, :, None], (REDRAWS, *seen.shape[:2], *added.shape[2:]))
    whole = np.concatenate([np.broadcast_to(seen, (REDRAWS, *seen.shape)), tail], axis=3)
    frames = read(jnp.asarray(whole.reshape(-1, *whole.shape[3:])))
    return Ground(
        places=walk.places,
        sources=sources,
        steps=steps_between(plain, walk, sources),
        frames=frames.reshape(*whole.shape[:3], *frames.shape[1:]),
        action=jnp.asarray(action, jnp.int32),
    )


def read_module(
    agent: sndjax.AgentSpec, state: sndjax.TrainState, frames: Frames, action: Any
) -> tuple[Float[Array, "R M"], Float[Array, "M d"]]:
    """Return the novelty of every place for every draw, and the features of the first draw.

    Args:
      agent: with a module that has features.
      state: of one agent.
      frames: see `Frames`.
      action: what is done in each place.
    """
    assert agent.intrinsic is not None
    module = agent.intrinsic.module
    assert module.features is not None
    features = module.features
    count = action.shape[0]
    no = jnp.zeros((1, count), bool)

    def novelty(pair: Any) -> Any:
        seen = scale_observations(agent, pair, state.observations)
        rollout = sndjax.Rollout(seen, action[None], no, no, ~no)
        signal, _ = module.reward(
            state.intrinsic, state.intrinsic_state, rollout, jax.random.key(0), False
        )
        return signal[0]

    here = scale_observations(agent, frames[0, 0], state.observations)
    return jax.lax.map(novelty, frames), features(
        state.intrinsic, state.intrinsic_state, here, action
    )


def rank_correlation(ground: Ground, features: np.ndarray) -> float:
    """Return Spearman's correlation of feature distance and steps over all pairs with a way.

    Args:
      ground: of the level.
      features: of its places, [M, d].
    """
    far = np.linalg.norm(features[ground.sources][:, None] - features[None], axis=-1)
    pairs = np.isfinite(ground.steps) & (ground.steps > 0)
    return float(stats.spearmanr(far[pairs], ground.steps[pairs]).statistic)


def share_of_distractor(novelty: np.ndarray) -> float:
    """Return the part of novelty's variance that is not between places but between draws.

    Args:
      novelty: [R, M].
    """
    total = novelty.var()
    return float(novelty.var(axis=0).mean() / total) if total > 0 else 0.0


def read_agent(
    ground: Ground, visited: np.ndarray, novelty: np.ndarray, features: np.ndarray
) -> dict[str, float | None]:
    """Return the figures of one agent at one time.

    Args:
      ground: of the level.
      visited: which numbers of places were visited, bool[P].
      novelty: [R, M].
      features: [M, d].
    """
    been, mean = visited[ground.places], novelty.mean(axis=0)
    known, unknown = mean[been], mean[~been]
    both = len(known) > 0 and len(unknown) > 0
    return {
        "visited": float(been.mean()),
        "novelty_visited": float(known.mean()) if len(known) else None,
        "novelty_unvisited": float(unknown.mean()) if len(unknown) else None,
        # That a place that was not visited has more novelty than one that was.
        "separation": probability_of_improvement(unknown, known) if both else None,
        "rank_correlation": rank_correlation(ground, features),
        "distractor_share": share_of_distractor(novelty),
    }


def trace_causes(
    protocol: Protocol, task: Task, method: Method, setting: Setting, known: Ground | None = None
) -> dict[str, list[list[float | None]]]:
    """Train a few agents of a row again, and read their modules on the way.

    Args:
      protocol: of the trial.
      task: of the row.
      method: of the row, with a module that has features.
      setting: of the method.
      known: of the task's level; None: it is found first.

    Returns:
      By figure a list for every agent of its values at the beginning and after each tenth.
    """
    arguments = run_arguments(protocol, task, method, setting.choices, TOGETHER)
    config = load_config(arguments)
    population = Population(config, READINGS)
    experiment = population.experiment
    ground = known or find_ground(config, experiment.pool.reader.read)
    read = jax.jit(lambda state: read_module(experiment.agent, state, ground.frames, ground.action))
    agents = population.start(protocol.seeds[:TOGETHER])
    numbers = {name: [value] * TOGETHER for name, value in setting.numbers.items()}
    found: dict[str, list[list[float | None]]] = {}
    for reading in range(READINGS + 1):
        if reading:
            agents, _ = population.train(agents, numbers)
        for i in range(TOGETHER):
            own = take(agents, i)
            novelty, features = map(np.asarray, read(own.train))
            assert own.environments.visits is not None
            visited = np.asarray(own.environments.visits.visited)
            for name, value in read_agent(ground, visited, novelty, features).items():
                found.setdefault(name, [[] for _ in range(TOGETHER)])[i].append(value)
    return found


def complete_causes(protocol: Protocol, task: Task, out: Path) -> bool:
    """Trace the causes of all rows of a task that have results, unless their files are there.

    The level must have no more than `places.MOST_STATES` states: five locked rooms and KeyCorridor
    have more.

    Args:
      protocol: of the trial.
      task: of the rows.
      out: the directory of the trial's results.

    Returns:
      Whether a row has results.

    Raises:
      ConfigError: the level is too large, or has no places.
    """
    ground, some = None, False
    for method in protocol.methods.values():
        path, row = (row_path(out, stage, task, method) for stage in ("causes", "rows"))
        some |= row.exists()
        if path.exists() or not row.exists():
            continue
        stored = json.loads(row.read_text())
        setting = Setting(stored["numbers"], stored["choices"])
        config = load_config(run_arguments(protocol, task, method, setting.choices, TOGETHER))
        probe = build_experiment(config, probe=True)
        if probe.agent.intrinsic is None:
            continue
        if ground is None:
            print(f"{task.name}: walking through the level, a minute or two", flush=True)
            ground = find_ground(config, probe.pool.reader.read)
        print(f"{task.name}/{method.name}: training {TOGETHER} agents", flush=True)
        found = trace_causes(protocol, task, method, setting, ground)
        write_json(path, {"task": task.name, "method": method.name, "steps": task.steps, **found})
        print(f"{task.name}/{method.name}: {path}", flush=True)
    return some
