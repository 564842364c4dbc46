"""The places of a fixed level: a state of each, and how many steps lie between them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sndjax

from ..system.errors import ConfigError

MOST_STATES = 1_000_000
CHUNK = 8192  # states that are stepped at once


class Point(NamedTuple):
    """States of an environment and what is seen of them, leaves [B, ...]."""

    state: Any
    observation: Any


class Walk(NamedTuple):
    """A breadth-first search of an environment.

    Attributes:
      points: a state of each place that was found, leaves [M, ...].
      places: their numbers, int[M], in the order in which they were found.
      steps: from the beginning to each, int[M].
    """

    points: Point
    places: np.ndarray
    steps: np.ndarray


class Expanded(NamedTuple):
    """What follows every action, leaves [B, A, ...]."""

    point: Point
    label: Any  # uint32[..., 2], two numbers that tell observations apart
    place: Any
    ended: Any


Expand = Callable[[Point], Expanded]


def take(tree: Any, rows: Any) -> Any:
    """Return some rows of all leaves."""
    return jax.tree.map(lambda x: x[rows], tree)


def make_expand(env: sndjax.JaxEnvironment) -> Expand:
    """Return a jitted function that takes every action in every state.

    Args:
      env: with `place`, whose step does not depend on its key, and whose observations are whole
        numbers.
    """
    assert env.place is not None
    place, key = env.place, jax.random.key(0)
    shape = jax.eval_shape(env.reset, key)[1].shape
    mix = jax.random.bits(jax.random.key(1), (2, *shape), jnp.uint32)

    def follow(point: Point, action: Any) -> Expanded:
        state, observation, _, ended, _ = env.step(key, point.state, action)
        whole = observation.astype(jnp.int32).astype(jnp.uint32)
        label = (whole[None] * mix).reshape(2, -1).sum(1, dtype=jnp.uint32)
        return Expanded(Point(state, observation), label, place(state), ended)

    actions = jnp.arange(env.num_actions)
    return jax.jit(jax.vmap(lambda point: jax.vmap(lambda a: follow(point, a))(actions)))


def expand_frontier(expand: Expand, frontier: Point, actions: int) -> Expanded:
    """Return what follows every action in many states, leaves [B * A, ...].

    Args:
      expand: see `make_expand`.
      frontier: the states.
      actions: A.
    """
    count, parts = len(frontier.observation), []
    for begin in range(0, count, CHUNK):
        rows = np.minimum(np.arange(begin, begin + CHUNK), count - 1)  # one shape, one program
        flat = jax.tree.map(
            lambda x: np.asarray(x).reshape(-1, *x.shape[2:]), expand(take(frontier, rows))
        )
        parts.append(take(flat, slice(min(CHUNK, count - begin) * actions)))
    return jax.tree.map(lambda *xs: np.concatenate(xs), *parts)


def walk_from(env: sndjax.JaxEnvironment, expand: Expand, start: Point) -> Walk:
    """Search an environment from a state until no new state is found.

    States whose observations are equal count as one. An episode's last state is found, and not
    left.

    Args:
      env: with `place`.
      expand: see `make_expand`.
      start: the state, without an axis of states.

    Raises:
      ConfigError: it has more than `MOST_STATES` states.
    """
    assert env.place is not None
    frontier = jax.tree.map(lambda x: np.asarray(x)[None], start)
    first = np.array([int(env.place(start.state))])
    points, places, steps = [frontier], [first], [np.zeros(1, int)]
    known, seen = np.zeros(0, np.uint64), set(first.tolist())
    depth = 0
    while len(frontier.observation):
        depth += 1
        after = expand_frontier(expand, frontier, env.num_actions)
        high, low = after.label.astype(np.uint64).T
        codes = high << np.uint64(32) | low
        _, once = np.unique(codes, return_index=True)
        fresh = once[~np.isin(codes[once], known)]
        known = np.union1d(known, codes[fresh])
        if len(known) > MOST_STATES:
            raise ConfigError(f"the level has more than {MOST_STATES:,} states")
        _, one_each = np.unique(after.place[fresh], return_index=True)
        new = np.array([i for i in fresh[one_each] if int(after.place[i]) not in seen], int)
        seen |= set(after.place[new].tolist())
        points.append(take(after.point, new))
        places.append(after.place[new])
        steps.append(np.full(len(new), depth))
        frontier = take(after.point, fresh[~after.ended[fresh]])
    joined = jax.tree.map(lambda *xs: np.concatenate(xs), *points)
    return Walk(joined, np.concatenate(places), np.concatenate(steps))


def walk_level(env: sndjax.JaxEnvironment) -> Walk:
    """Search an environment from the state that its episodes start in.

    Args:
      env: with `place`.

    Raises:
      ConfigError: it has more than `MOST_STATES` states.
    """
    return walk_from(env, make_expand(env), Point(*env.reset(jax.random.key(0))))


def steps_between(env: sndjax.JaxEnvironment, walk: Walk, sources: np.ndarray) -> np.ndarray:
    """Return the steps from some places to all places of a walk, float[K, M]; inf: no way.

    Args:
      env: the environment.
      walk: from its beginning.
      sources: the indices of K places in it.
    """
    expand = make_expand(env)
    found = np.full((len(sources), len(walk.places)), np.inf)
    index = {int(place): i for i, place in enumerate(walk.places)}
    for row, source in zip(found, sources, strict=True):
        own = walk_from(env, expand, take(walk.points, source))
        for place, steps in zip(own.places, own.steps, strict=True):
            if int(place) in index:
                row[index[int(place)]] = steps
    return found
