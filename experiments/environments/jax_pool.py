"""A pool of environments that live in JAX, for agents that play step by step."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sndjax.collecting import init_with_keys, step_with_keys

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
        # A key for each environment, from its seed: it plays alike in every pool.
        self.keys = [jax.vmap(jax.random.key)(jnp.array(own, jnp.uint32)) for own in seeds]
        fold = jax.vmap(jax.random.fold_in, (0, None))
        self.make = jax.jit(lambda keys: init_with_keys(env, fold(keys, 0)))

        def step(live: Any, action: Any, keys: Any, t: Any) -> Any:
            row, after = step_with_keys(env, live, action, fold(keys, t))
            return (after.frame, row.reward, row.done & ~row.truncated, row.truncated), after

        self.step_one = jax.jit(step)

    def reset(self) -> np.ndarray:
        self.time = 0
        with task_errors(self.config.id):
            self.live = [self.make(keys) for keys in self.keys]
            return self.first_frames(self.joined([live.frame for live in self.live]))

    def send(self, action: np.ndarray) -> None:
        self.time += 1
        with task_errors(self.config.id):
            steps = [
                self.step_one(live, np.asarray(chosen, np.int32), keys, self.time)
                for live, chosen, keys in zip(self.live, action, self.keys, strict=True)
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

    def draw(self) -> np.ndarray:
        assert self.environment is not None
        if self.environment.draw is None:
            return super().draw()
        with task_errors(self.config.id):
            first = jax.tree.map(lambda x: x[0], self.live[0].state)
            return np.asarray(self.environment.draw(first))

    def close(self) -> None:
        """Do nothing: these environments have no processes."""
