"""A pool of environments that live in JAX, for agents that play step by step."""

from functools import partial
from typing import Any

import jax
import numpy as np

import sndjax

from ..config.envpool_tasks import gym
from ..config.schema import EnvConfig
from .jax_environments import make_environment, observation_space, read_frames
from .pool import EnvStep, Pool, task_errors


class JaxPool(Pool):
    """A pool of environments that live in JAX."""

    def __init__(self, config: EnvConfig, seeds: list[list[int]]):
        env = make_environment(config)
        space: Any = observation_space(env)
        actions: Any = gym.spaces.Discrete(env.num_actions)
        super().__init__(config, len(seeds), len(seeds[0]), space, actions)
        self.environment = read_frames(env, self.reader)
        # A pool of one host: the stream of an agent's environments is that of its first one.
        self.keys = [jax.random.key(own[0]) for own in seeds]
        self.make = jax.jit(partial(sndjax.init_environments, env, num_envs=len(seeds[0])))

        def step(live: Any, action: Any, key: Any, t: Any) -> Any:
            key = jax.random.fold_in(key, t)
            row, after = sndjax.step_environments(env, live, action, key)
            return (after.frame, row.reward, row.done & ~row.truncated, row.truncated), after

        self.step_one = jax.jit(step)

    def reset(self) -> np.ndarray:
        self.time = 0
        with task_errors(self.config.id):
            self.live = [self.make(jax.random.fold_in(key, 0)) for key in self.keys]
            return self.first_frames(self.joined([live.frame for live in self.live]))

    def send(self, action: np.ndarray) -> None:
        self.time += 1
        with task_errors(self.config.id):
            steps = [
                self.step_one(live, np.asarray(chosen, np.int32), key, self.time)
                for live, chosen, key in zip(self.live, action, self.keys, strict=True)
            ]
        self.columns = [columns for columns, _ in steps]
        self.live = [live for _, live in steps]

    def receive(self) -> EnvStep:
        with task_errors(self.config.id):
            frame, reward, terminated, truncated = map(self.joined, zip(*self.columns, strict=True))
            return self.step_of(frame, reward, reward, terminated, truncated)

    @staticmethod
    def joined(parts: Any) -> np.ndarray:
        """Return the arrays of all seeds as one, [S * N, ...]."""
        return np.concatenate([np.asarray(part) for part in parts])

    def close(self) -> None:
        """Do nothing: these environments have no processes."""
