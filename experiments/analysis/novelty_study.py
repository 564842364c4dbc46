"""The signal of a module along a trajectory, trained only on the past (Fig. 5.11)."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax

import sndjax
from sndjax import Rollout, slice_transitions

from ..config.compose import load_config
from ..reporting.seed_statistics import probability_of_improvement
from ..training.agents import make_intrinsic_config
from .montezuma_path import ACTION_LETTERS, Trajectory

WINDOWS = ("past", "near", "far", "random")
NEAR = 128  # steps that the near future covers
DRAWN = 64  # states that each of the other windows draws
STEPS, RUNS = 4, 32  # a minibatch: RUNS segments of STEPS consecutive pairs


class StudyState(NamedTuple):
    """The parameters, the optimizer state and the module state of a study."""

    params: Any
    optimizer: optax.OptState
    state: Any


def gather_runs(walk: Trajectory, start: np.ndarray, steps: int) -> Rollout:
    """Gather segments of consecutive pairs as a rollout [..., steps, N].

    Args:
      walk: the trajectory.
      start: int[..., N], the index of the first pair of each segment.
      steps: the number of pairs in a segment.
    """
    index = start[..., None, :] + np.arange(steps + 1)[:, None]
    pairs = index[..., :-1, :]
    no, yes = np.zeros(pairs.shape, bool), np.ones(pairs.shape, bool)
    parts: Any = (walk.frames[index], walk.action[pairs], no, no, yes)
    return jax.tree.map(jnp.asarray, Rollout(*parts))


def draw_windows(n: int, last: int, draw: np.random.Generator) -> list[np.ndarray]:
    """Return the indices of the pairs in each of `WINDOWS` at step n.

    The near future, n < m < n + 128, is complete; from the other windows some pairs are drawn.

    Args:
      n: the step.
      last: the index of the last pair.
      draw: the random generator.
    """
    return [
        draw.integers(0, n, DRAWN),
        n + 1 + np.arange(NEAR - 1),
        draw.integers(n + 1, last + 1, DRAWN),
        draw.integers(0, last + 1, DRAWN),
    ]


def make_study_steps(name: str) -> tuple[Callable[..., StudyState], Callable[..., Any]]:
    """Make the two jitted steps of a module's study.

    Args:
      name: the name of an algorithm.

    Returns:
      begin(key, example) -> the state before any training; advance(study, rollouts, keys, window,
      key) -> the state after a training step on each rollout, and the signal of the window. The
      input statistics do not include the window, because most of it is in the future.
    """
    config = load_config(["env=MontezumaRevenge", f"algo={name}"])
    intrinsic = make_intrinsic_config(config, len(ACTION_LETTERS), sndjax.ATARI)
    assert intrinsic is not None
    module, optimizer = intrinsic.module, optax.adam(intrinsic.learning_rate)

    @jax.jit
    def begin(key: jax.Array, example: jax.Array) -> StudyState:
        params, state = module.init(key, example)
        return StudyState(params, optimizer.init(params), state)

    def train(study: StudyState, inputs: tuple[Rollout, jax.Array]) -> tuple[StudyState, None]:
        (params, optimizer_state, state), (rollout, key) = study, inputs
        _, state = module.reward(params, state, rollout, key)  # updates the input statistics
        batch = slice_transitions(rollout, jnp.zeros((), jnp.int32), STEPS * RUNS)
        gradient, _ = jax.grad(module.loss, has_aux=True)(params, state, batch, rollout, key)
        updates, optimizer_state = optimizer.update(gradient, optimizer_state, params)
        params = optax.apply_updates(params, updates)
        return StudyState(params, optimizer_state, module.update(params, state)), None

    @partial(jax.jit, donate_argnums=0)
    def advance(
        study: StudyState, rollouts: Rollout, keys: jax.Array, window: Rollout, key: jax.Array
    ) -> tuple[StudyState, jax.Array]:
        study, _ = lax.scan(train, study, (rollouts, keys))
        signal, _ = module.reward(study.params, study.state, window, key, update_statistics=False)
        return study, signal[0]

    return begin, advance


def study_module(
    name: str,
    walk: Trajectory,
    train_every: int,
    read_every: int,
    seed: int,
    report: Callable[[int], None] = lambda n: None,
) -> tuple[np.ndarray, np.ndarray]:
    """Train a module along a trajectory, and read its signal at regular steps.

    Args:
      name: the name of an algorithm.
      walk: the trajectory, M states.
      train_every: the number of states between gradient steps.
      read_every: the number of states between readings; a multiple of `train_every`.
      seed: the seed of the weights and the random draws.
      report: called with the step n.

    Returns:
      The steps where the signal was read, int[R], and its mean in each of `WINDOWS`, float[R, 4].
    """
    begin, advance = make_study_steps(name)
    draw, key = np.random.default_rng(seed), jax.random.key(seed)
    learner, last = begin(key, walk.frames[:1]), len(walk.action) - 1
    where = np.arange(read_every, last - NEAR, read_every)
    means = []
    for n in where.tolist():
        # The pairs m ... m + 3 of a segment are all before the step.
        steps = np.arange(n - read_every + train_every, n + 1, train_every)
        start = np.stack(
            [draw.integers(0, max(step - STEPS, 0) + 1, RUNS) for step in steps.tolist()]
        )
        windows = draw_windows(n, last, draw)
        learner, found = advance(
            learner,
            gather_runs(walk, start, STEPS),
            jax.random.split(jax.random.fold_in(key, n), len(steps)),
            gather_runs(walk, np.concatenate(windows), 1),
            jax.random.fold_in(key, n),
        )
        ends = np.cumsum([len(window) for window in windows])[:-1]
        means.append([part.mean() for part in np.split(np.asarray(found), ends)])
        report(n)
    return where, np.array(means)


def study_figures(where: np.ndarray, means: np.ndarray, visits: list[int]) -> dict[str, float]:
    """Compute the figures that test the claims of Fig. 5.11.

    Args:
      where: the steps that `study_module` returns.
      means: the means that `study_module` returns.
      visits: the steps at which a room is entered for the first time.

    Returns:
      far_over_past: the median over readings of the far future's signal divided by the past's.
      far_over_past_last_quarter: the same for the last quarter of the readings.
      near_last_over_first: the near future's mean in the last quarter of the readings divided by
        its mean in the first quarter.
      new_room_ahead: the probability that near / past is higher at a step with a new room in the
        near future than at a step without one; 0.5 is chance, NaN if one of the two kinds of steps
        is missing.

    >>> same = [1.0, 2.0, 4.0, 1.0]
    >>> means = np.array([same, [1.0, 9.0, 4.0, 1.0], same, [1.0, 1.0, 1.0, 1.0]])
    >>> for name, value in study_figures(np.array([0, 200, 400, 600]), means, [250]).items():
    ...     print(name, value)
    far_over_past 4.0
    far_over_past_last_quarter 1.0
    near_last_over_first 0.5
    new_room_ahead 1.0
    """
    past, near, far, _ = means.T
    quarter = max(1, len(where) // 4)
    ahead = np.array([any(n < visit < n + NEAR for visit in visits) for n in where.tolist()])
    mixed = ahead.any() and not ahead.all()
    return {
        "far_over_past": float(np.median(far / past)),
        "far_over_past_last_quarter": float(np.median((far / past)[-quarter:])),
        "near_last_over_first": float(near[-quarter:].mean() / near[:quarter].mean()),
        "new_room_ahead": probability_of_improvement((near / past)[ahead], (near / past)[~ahead])
        if mixed
        else float("nan"),
    }
