"""Make random rollouts with real episode structure, for every kind of input."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from sndjax import ATARI, PROCGEN, VECTOR, Architecture, Experience, Rollout


class Kind(NamedTuple):
    """A kind of input at toy size."""

    name: str
    size: Architecture
    shape: tuple[int, ...]
    actions: int


TOY = {
    "channels": (8, 8, 8),
    "last": 8,
    "last_predictor": 8,
    "rnd_channels": (8, 8, 8),
    "features": 16,
}
KINDS = [
    Kind("atari", ATARI._replace(**TOY), (24, 24, 1), 18),
    Kind("procgen", PROCGEN._replace(**TOY), (24, 24, 3), 15),
    Kind("vector", VECTOR._replace(features=16, hidden=(8, 8)), (5,), 3),
]


def episodes(rng, steps, envs, chance=0.2):
    """Return first, done, valid of rows with next-step resets, which may start mid-episode."""
    first = np.zeros((steps, envs), bool)
    done = np.zeros((steps, envs), bool)
    valid = np.ones((steps, envs), bool)
    for n in range(envs):
        # What the row before this rollout was decides how the rollout begins.
        state = rng.choice(["inside", "first", "reset"])
        for t in range(steps):
            if state == "reset":
                valid[t, n] = False
                state = "first"
                continue
            first[t, n] = state == "first"
            done[t, n] = rng.random() < chance
            state = "reset" if done[t, n] else "inside"
    return first, done, valid


def frames(rng, shape, *rows):
    """Return random pixels for images, normal numbers for vectors."""
    if len(shape) == 3:
        return rng.integers(0, 256, (*rows, *shape), dtype=np.uint8)
    return rng.normal(size=(*rows, *shape)).astype(np.float32)


def rollout(kind, rng, steps=8, envs=4, chance=0.2):
    """Return a rollout of random frames and actions with real episode structure."""
    first, done, valid = episodes(rng, steps, envs, chance)
    action = rng.integers(0, kind.actions, (steps, envs)).astype(np.int32)
    made = Rollout(frames(rng, kind.shape, steps + 1, envs), action, first, done, valid)
    return Rollout(*map(jnp.asarray, made))


def experience(kind, rng, steps=8, envs=4, stack=1, heads=2):
    """Return a batch for `train_step` with a random rollout."""
    made = rollout(kind, rng, steps, envs)
    rows = (steps, envs)
    normal = lambda *shape: jnp.asarray(rng.normal(size=shape).astype(np.float32))
    return Experience(
        made,
        jnp.asarray(frames(rng, kind.shape, stack - 1, envs)),
        normal(*rows),
        jnp.asarray(rng.random(rows) < 0.5) & made.done,
        -jnp.abs(normal(*rows)) - 1,
        normal(steps + 1, envs, heads),
    )


def no_encode(frames, action=None):
    """Replace the encoder where a loss does not use it."""
    raise AssertionError("this loss encodes no further frames")


NO_ROLLOUT = Rollout(*5 * [None])  # where a loss does not read it
