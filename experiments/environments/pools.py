"""Pools of environments for all seeds of a run, with observations read as frames."""

import sys
from dataclasses import replace
from typing import Any, cast

import numpy as np

from ..config.envpool_tasks import envpool, family_of, gym, registry
from ..config.schema import EnvConfig
from ..config.validation import unknown_name_error
from ..system.errors import ConfigError
from .pool import EnvStep, Pool, task_errors

TOYS = ("envpool.classic_control", "envpool.toy_text")  # one thread steps these faster than two
MONTEZUMA_ROOM = 3  # index of the RAM byte that holds the room number


def env_seeds(seed: int, num_envs: int, start: int) -> list[int]:
    """Return one seed per environment, hashed from the run's seed and its start iteration.

    A resumed run therefore has new random streams, and seeds k and k + 1 share no stream.

    Args:
      seed: the seed of the agent.
      num_envs: the number of environments of this seed.
      start: the iteration that the run starts at.
    """
    return [
        int(np.random.SeedSequence([seed, env, start]).generate_state(1)[0] & 0x7FFFFFFF)
        for env in range(num_envs)
    ]


class EnvpoolPool(Pool):
    """A pool of envpool environments, which run in the threads of envpool."""

    def __init__(self, config: EnvConfig, seeds: list[list[int]], threads: int | None = None):
        """Make the environments.

        Args:
          config: the task.
          seeds: the seed of each environment of each agent.
          threads: that step them, unless env.options.num_threads is given; None: envpool's choice,
            one for each core.

        Raises:
          ConfigError: envpool cannot make the task.
        """
        family_of(config.id)
        if registry.specs[config.id][0] in TOYS:
            threads = 1
        try:
            self.envs = envpool.make(
                config.id,
                env_type="gymnasium",
                num_envs=len(seeds) * len(seeds[0]),
                seed=[seed for own in seeds for seed in own],
                **({} if threads is None else {"num_threads": threads}) | config.options,
            )
        except Exception as error:  # envpool raises many types; all concern its input
            message = str(error).strip().splitlines() or [repr(error)]
            raise ConfigError(f"envpool cannot make {config.id}: {message[0]}") from None
        space, actions = self.envs.observation_space, self.envs.action_space
        super().__init__(config, len(seeds), len(seeds[0]), space, actions)
        self.rooms = config.id.startswith("MontezumaRevenge")

    def reset(self) -> np.ndarray:
        with task_errors(self.config.id):
            observation, _ = self.envs.reset()
        return self.first_frames(observation)

    def send(self, action: np.ndarray) -> None:
        with task_errors(self.config.id):
            self.envs.send(np.asarray(action, np.int32).reshape(-1))

    def receive(self) -> EnvStep:
        with task_errors(self.config.id):
            observation, reward, terminated, truncated, info = self.envs.recv()
            room = info["ram"][:, MONTEZUMA_ROOM] if self.rooms else None
            score = cast(np.ndarray, info.get("reward", reward))
            game_over = None
            if "terminated" in info:  # Atari: the game itself is over, also at the step limit
                over = np.asarray(info["terminated"], bool)
                terminated = terminated | (truncated & over)
                game_over = over | truncated
            return self.step_of(observation, reward, score, terminated, truncated, game_over, room)

    def draw(self) -> np.ndarray:
        """Return an image of the first environment; the pool needs `render_mode="rgb_array"`."""
        return np.asarray(self.envs.render(env_ids=np.zeros(1, int)))[0]

    def close(self) -> None:
        self.envs.close()


class GymnasiumPool(Pool):
    """A pool made by `gymnasium.make_vec`, also for environments that the user wrote."""

    def __init__(self, config: EnvConfig, seeds: list[list[int]]):
        count = len(seeds) * len(seeds[0])
        if "" not in sys.path:
            sys.path.insert(0, "")  # find env.id=my_file:MyTask-v0 in the working directory
        try:
            # Not the vector version of a task: such versions differ in options and in resets.
            options = {"vectorization_mode": "sync"} | config.options
            self.envs = gym.make_vec(config.id, num_envs=count, **options)
        except gym.error.NameNotFound:
            raise unknown_name_error("gymnasium task", config.id, gym.registry) from None
        except (Exception, SystemExit) as error:  # a user's environment may raise anything
            message = str(error).strip().splitlines() or [repr(error)]
            raise ConfigError(f"gymnasium cannot make {config.id}: {message[0]}") from None
        mode = self.envs.metadata.get("autoreset_mode")
        if mode != gym.vector.AutoresetMode.NEXT_STEP:
            raise ConfigError(
                f"{config.id} resets in mode {mode}; only AutoresetMode.NEXT_STEP keeps an "
                "episode's last observation"
            )
        space, actions = self.envs.single_observation_space, self.envs.single_action_space
        super().__init__(config, len(seeds), len(seeds[0]), space, actions)
        self.first_action = int(getattr(actions, "start", 0))
        self.seeds = [seed for own in seeds for seed in own]

    def reset(self) -> np.ndarray:
        with task_errors(self.config.id):
            observation, _ = self.envs.reset(seed=cast(Any, self.seeds))
        return self.first_frames(observation)

    def send(self, action: np.ndarray) -> None:
        self.action = np.asarray(action, np.int64).reshape(-1) + self.first_action

    def receive(self) -> EnvStep:
        with task_errors(self.config.id):
            observation, reward, terminated, truncated, _ = self.envs.step(self.action)
            return self.step_of(observation, reward, reward, terminated, truncated)

    def close(self) -> None:
        try:
            self.envs.close()
        except Exception:  # a process of env.options.vectorization_mode=async has died
            for process in getattr(self.envs, "processes", ()):
                process.terminate()
                process.join(1)


def whole_games(config: EnvConfig) -> EnvConfig:
    """Return the task without `episodic_life`, for agents that play whole games."""
    if not config.options.get("episodic_life"):
        return config
    return replace(config, options=config.options | {"episodic_life": False})


def make_pools(
    config: EnvConfig,
    seeds: list[int],
    num_envs: int,
    start: int = 0,
    groups: int = 1,
    local_envs: slice = slice(None),
    threads: int | None = None,
) -> list[Pool]:
    """Return the environments of a configuration, in pools that step independently.

    Args:
      config: the task and how it is read.
      seeds: one seed per agent.
      num_envs: the number of environments of each seed.
      start: the iteration that the run starts at.
      groups: the number of pools; the random streams of the environments do not depend on it.
      local_envs: the environments of each seed that this host steps.
      threads: see `EnvpoolPool`.

    Raises:
      ConfigError: the task cannot be made with these options, or cannot be trained on.
    """
    streams = [env_seeds(seed, num_envs, start)[local_envs] for seed in seeds]
    size = len(streams[0]) // groups
    return [
        make_pool_of(config, [own[k * size : (k + 1) * size] for own in streams], threads)
        for k in range(groups)
    ]


def make_pool_of(config: EnvConfig, streams: list[list[int]], threads: int | None = None) -> Pool:
    """Return a pool of environments with given seeds.

    Args:
      config: the task and how it is read.
      streams: the seed of each environment of each agent.
      threads: see `EnvpoolPool`.

    Raises:
      ConfigError: the task cannot be made with these options, or cannot be trained on.
    """
    if config.suite == "envpool":
        return EnvpoolPool(config, streams, threads)
    if config.suite == "gymnasium":
        return GymnasiumPool(config, streams)
    from .jax_pool import JaxPool  # imports jax

    return JaxPool(config, streams)


def make_pool(config: EnvConfig, seeds: list[int], num_envs: int, start: int = 0) -> Pool:
    """Return all environments of a configuration in one pool. See `make_pools`.

    Args:
      config: the task and how it is read.
      seeds: one seed per agent.
      num_envs: the number of environments of each seed.
      start: the iteration that the run starts at.

    Raises:
      ConfigError: the task cannot be made with these options, or cannot be trained on.
    """
    (pool,) = make_pools(config, seeds, num_envs, start)
    return pool
