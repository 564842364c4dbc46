"""The committed trajectory through Montezuma's Revenge: a list of actions, and its frames.

`experiments/data/montezuma.json` holds the actions; the frames are made by playing them.
"""

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..config.compose import load_config
from ..config.schema import EnvConfig
from ..environments.pools import make_pool
from ..system.errors import ConfigError

DATA = Path(__file__).parents[1] / "data" / "montezuma.json"
ACTION_LETTERS = "abcdefghijklmnopqr"  # one letter per action


class Trajectory(NamedTuple):
    """A trajectory: states s_0 ... s_M-1 and the actions between them."""

    frames: np.ndarray  # uint8[M, 96, 96, 1]
    action: np.ndarray  # int32[M - 1]
    room: np.ndarray  # uint8[M - 1], of s_1 ... s_M-1


def deterministic_env_config() -> EnvConfig:
    """Return the environment configuration of the experiments, without sticky actions."""
    env = load_config(["env=MontezumaRevenge", "algo=ppo"]).env
    return replace(env, options={**env.options, "repeat_action_probability": 0.0})


def play_actions(actions: bytes) -> Trajectory:
    """Play a list of actions with envpool, and return the trajectory."""
    pool = make_pool(deterministic_env_config(), [0], 1)
    frames, rooms = [pool.reset()[0, 0]], []
    for action in actions:
        step = pool.step(np.full((1, 1), action, np.int32))
        assert step.room is not None
        frames.append(step.frame[0, 0])
        rooms.append(step.room[0, 0])
    pool.close()
    taken = np.frombuffer(actions, np.uint8).astype(np.int32)
    return Trajectory(np.stack(frames), taken, np.array(rooms, np.uint8))


def trajectory_digest(walk: Trajectory) -> str:
    """Return the SHA-256 of the frames of a trajectory."""
    return hashlib.sha256(walk.frames.tobytes()).hexdigest()


def load_committed_trajectory(path: Path = DATA) -> Trajectory:
    """Play the committed list of actions, and return the trajectory.

    Raises:
      ConfigError: the actions lead to other frames than when they were committed.
    """
    stored = json.loads(path.read_text())
    walk = play_actions(bytes(ACTION_LETTERS.index(letter) for letter in stored["actions"]))
    if trajectory_digest(walk) != stored["sha256"]:
        raise ConfigError(
            f"{path.name} leads to other frames than it did with envpool {stored['envpool']}: "
            "search for another: sndjax trajectory"
        )
    return walk
