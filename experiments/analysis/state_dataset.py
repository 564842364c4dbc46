"""Sequences of states, and their features in the networks of a run."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sndjax.acting import scale_observations
from sndjax.actor_critic import torso_features
from sndjax.rollout import stack_to_channels

from ..evaluation.players import Player, cut_message, play_episodes
from ..system.errors import ConfigError
from ..training.agents import make_encode
from .montezuma_path import load_committed_trajectory

BATCH, TOGETHER = 128, 4  # states per network call, episodes played side by side


class States(NamedTuple):
    """M states, whole episodes one after another (the last one may be cut)."""

    frames: np.ndarray  # [M, *frame]
    action: np.ndarray  # int32[M], 0 where an episode ends
    age: np.ndarray  # int[M], steps since its episode began
    room: np.ndarray | None  # int[M], in Montezuma's Revenge

    @property
    def follows(self) -> np.ndarray:
        """Return whether state m + 1 is the successor of state m, bool[M - 1]."""
        return self.age[1:] > 0

    def cut(self, count: int) -> "States":
        """Return the first `count` states."""
        return States._make(None if x is None else x[:count] for x in self)


def collect_states(
    player: Player, count: int, seed: int, report: Callable[[int], None] = lambda count: None
) -> States:
    """Collect the states of whole episodes, with sampled actions, until there are enough.

    An episode is played no further than `count` steps, or until the memory is full; the second is
    printed, because then the states are not of whole episodes.

    Args:
      player: the agent.
      count: the number of states to collect.
      seed: the seed of the environments.
      report: called with the number of states so far.
    """
    parts: list[States] = []
    total = 0
    while total < count:
        played = play_episodes(player, TOGETHER, seed=seed + len(parts), max_steps=count)
        if not parts and any(len(e.action) < count and not e.complete for e in played):
            print(cut_message(played, count))
        for episode in played:
            length = len(episode.action)  # the last state has no successor and is dropped
            room = np.concatenate([episode.room[:1], episode.room[:-1]]).astype(int)
            states = States(episode.frames[:length], episode.action, np.arange(length), room)
            parts.append(states)
            total += length
        report(min(total, count))
    joined: Any = [np.concatenate(column) for column in zip(*parts, strict=True)]
    states = States(*joined)
    return (
        states if states.room is not None and states.room.any() else states._replace(room=None)
    ).cut(count)


def trajectory_states(count: int) -> States:
    """Return the first `count` states of the committed trajectory through Montezuma's Revenge.

    Raises:
      ConfigError: see `load_committed_trajectory`.
    """
    walk = load_committed_trajectory()
    room = np.concatenate([walk.room[:1], walk.room]).astype(int)
    action = np.append(walk.action, 0).astype(np.int32)
    return States(walk.frames, action, np.arange(len(walk.frames)), room).cut(count)


def apply_in_batches(function: Callable[..., Any], *arrays: np.ndarray) -> np.ndarray:
    """Apply a jitted function of `BATCH` rows to all rows; the last batch is padded."""
    parts = []
    for start in range(0, len(arrays[0]), BATCH):
        own = [x[start : start + BATCH] for x in arrays]
        size = len(own[0])
        filled = [np.concatenate([x, x[-1:].repeat(BATCH - size, 0)]) for x in own]
        parts.append(np.asarray(function(*filled))[:size])
    return np.concatenate(parts)


def encode_states(player: Player, states: States) -> np.ndarray | None:
    """Return the encoder's features of the states, float32[M, d]; None for the baseline.

    Raises:
      ConfigError: the module has no features.
    """
    if player.agent.intrinsic is None:
        return None
    encode = make_encode(player.agent)
    if encode is None:
        raise ConfigError(f"algo={player.config.algo.name} has no features to show")
    return apply_in_batches(partial(encode, player.state), states.frames, states.action)


def policy_torso_features(player: Player, states: States) -> np.ndarray:
    """Return the features of the states in the policy's torso, float32[M, d]."""
    stack = player.agent.stack

    @jax.jit
    def apply(stacked: jax.Array) -> jax.Array:
        seen = scale_observations(player.agent, stacked, player.state.observations)
        seen = stack_to_channels(jnp.moveaxis(seen, 1, 0))
        return torso_features(player.agent.network, player.state.policy, seen)

    def apply_rows(rows: np.ndarray) -> jax.Array:
        back = np.arange(stack.size - 1, -1, -1)
        age = states.age[rows][:, None]
        older = np.minimum(back, age) if stack.repeat else np.where(back <= age, back, 0)
        stacked = states.frames[rows[:, None] - older]
        if not stack.repeat:
            stacked[back > age] = 0
        return apply(stacked)

    return apply_in_batches(apply_rows, np.arange(len(states.frames)))
