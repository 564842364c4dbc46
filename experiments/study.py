"""How one module's signal comes to know a trajectory, trained on its past alone (Fig. 5.11)."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax

import sndjax
from experiments.agents import motivation_of
from experiments.config import load
from experiments.trajectory import LETTERS, Walk
from sndjax import Rollout, transitions

WINDOWS = ("past", "near", "far", "random")
SIZE = 128  # pairs of a minibatch, states of a window, and how far the near future reaches


class Learner(NamedTuple):
    """A module with what its training moves."""

    params: Any
    optimizer: optax.OptState
    state: Any


def pairs(walk: Walk, index: np.ndarray) -> Rollout:
    """The pairs (s_m, s_m+1) of some m, int[N], as a rollout of one step."""
    frames = np.stack([walk.frames[index], walk.frames[index + 1]])
    rows = (1, len(index))
    no, yes = np.zeros(rows, bool), np.ones(rows, bool)
    action = walk.action[index][None]
    return jax.tree.map(jnp.asarray, Rollout(*cast(Any, (frames, action, no, no, yes))))


def windows_of(n: int, last: int, draw: np.random.Generator) -> np.ndarray:
    """Which pairs each window reads at step n, int[4, SIZE], of the pairs 0 ... last.

    The near future is all of its states (and one twice); of the others as many are drawn.
    """
    return np.stack(
        [
            draw.integers(0, n, SIZE),
            n + 1 + np.arange(SIZE) % (SIZE - 1),
            draw.integers(n + 1, last + 1, SIZE),
            draw.integers(0, last + 1, SIZE),
        ]
    )


def taking_nothing_in(state: Any) -> Any:
    """The module's state with its input moments so heavy that what is read does not move them.

    A module's `reward` takes the frames in before it reads them; here most are of the future.
    """
    moments = state["moments"]
    if moments is None:
        return state
    heavy = moments._replace(samples=1e6 * moments.samples, m2=1e6 * moments.m2)
    return state | {"moments": heavy}


def steps_of(name: str) -> tuple[Any, Callable[..., Learner], Callable[..., jax.Array]]:
    """Jitted functions of a module: to begin, to train on pairs, and to read its signal."""
    algo = load(["env=MontezumaRevenge", f"algo={name}"]).algo
    motivation = motivation_of(algo, len(LETTERS), sndjax.ATARI)
    module, optimizer = motivation.module, optax.adam(motivation.learning_rate)

    @jax.jit
    def begin(key, example):
        params, state = module.init(key, example)
        return Learner(params, optimizer.init(params), state)

    @partial(jax.jit, donate_argnums=0)
    def train(learner, rollout, key):
        params, optimizer_state, state = learner
        _, state = module.reward(params, state, rollout, key)  # its moments take the pairs in
        batch = transitions(rollout, jnp.arange(rollout.action.size))
        gradient, _ = jax.grad(module.loss, has_aux=True)(params, state, batch, rollout, key)
        updates, optimizer_state = optimizer.update(gradient, optimizer_state, params)
        params = optax.apply_updates(params, updates)
        return Learner(params, optimizer_state, module.update(params, state))

    @jax.jit
    def signal(learner, rollout, key):
        state = taking_nothing_in(learner.state)
        return module.reward(learner.params, state, rollout, key)[0][0]

    return begin, train, signal


def study(
    name: str,
    walk: Walk,
    train_every: int,
    read_every: int,
    seed: int,
    report: Callable[[int], None] = lambda n: None,
) -> tuple[np.ndarray, np.ndarray]:
    """Go along a trajectory with a module of this name.

    Args:
      name: of an algorithm.
      walk: the trajectory, M states.
      train_every, read_every: states between gradient steps, and between readings.
      seed: of the weights and the draws.
      report: called with the step n.

    Returns:
      Where the signal was read, int[R], and its mean in each of `WINDOWS`, float[R, 4].
    """
    begin, train, signal = steps_of(name)
    draw, key = np.random.default_rng(seed), jax.random.key(seed)
    learner, last = begin(key, walk.frames[:1]), len(walk.action) - 1
    where, means = [], []
    for n in range(1, last - SIZE):
        if n % train_every == 0:
            rollout = pairs(walk, draw.integers(0, n, SIZE))
            learner = train(learner, rollout, jax.random.fold_in(key, n))
        if n % read_every == 0:
            index = windows_of(n, last, draw)
            found = signal(learner, pairs(walk, index.reshape(-1)), jax.random.fold_in(key, n))
            where.append(n)
            means.append(np.asarray(found).reshape(index.shape).mean(1))
        report(n)
    return np.array(where), np.array(means)


def figures(where: np.ndarray, means: np.ndarray) -> dict[str, float]:
    """What Fig. 5.11 claims, in numbers.

    >>> same = [1.0, 2.0, 4.0, 1.0]
    >>> figures(np.arange(4), np.array([same, same, same, [1.0, 1.0, 1.0, 1.0]]))
    {'far_over_past': 3.25, 'near_over_past': 1.75, 'near_last_over_first_quarter': 0.5}
    """
    past, near, far, _ = means.T
    quarter = max(1, len(where) // 4)
    return {
        "far_over_past": float(far.mean() / past.mean()),
        "near_over_past": float(near.mean() / past.mean()),
        "near_last_over_first_quarter": float(near[-quarter:].mean() / near[:quarter].mean()),
    }
