"""Pools of environments for all seeds of a run, with observations read as frames."""

import sys
from typing import Any, NamedTuple, cast

import numpy as np

from ..config.envpool_tasks import envpool, family_of, gym
from ..config.schema import EnvConfig
from ..config.validation import unknown_name_error
from ..system.errors import ConfigError
from .observations import make_reader

MONTEZUMA_ROOM = 3  # index of the RAM byte that holds the room number


class EnvStep(NamedTuple):
    """The result of one step of every environment; all arrays are [S, N, ...]."""

    frame: np.ndarray  # the newest observation; where done, the true last one of the episode
    reward: np.ndarray  # float32, the training reward
    score: np.ndarray  # float32, the reward of the game itself
    done: np.ndarray
    truncated: np.ndarray
    valid: np.ndarray  # False where the environment was reset instead of stepped
    room: np.ndarray | None  # uint8, in Montezuma's Revenge


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


class Pool:
    """S x N environments of one task, stepped together.

    A reset takes one separate step, in which the action is ignored: that row is not valid.

    Attributes:
      num_actions: the number of actions A.
      shape: the shape of one frame, [H, W, C] or [D].
      dtype: the dtype of one frame, uint8 for [H, W, C] or float32 for [D].
      unbounded: for each component of a vector, whether it has no bounds.
      rooms: whether steps contain the room of Montezuma's Revenge.
    """

    rooms = False

    def __init__(self, config: EnvConfig, seeds: int, num_envs: int, space: Any, actions: Any):
        """Set the sizes and the reader from the spaces of one environment.

        Args:
          config: the task and how it is read.
          seeds: the number of seeds S.
          num_envs: the number of environments N of each seed.
          space: the observation space of one environment.
          actions: the action space of one environment.

        Raises:
          ConfigError: the actions are not discrete, or the observations cannot be read.
        """
        if not isinstance(actions, gym.spaces.Discrete):
            raise ConfigError(
                f"env.id={config.id} has {type(actions).__name__} actions; "
                "only tasks with discrete actions can be trained on"
            )
        self.config = config
        self.rows = (seeds, num_envs)
        self.reader = make_reader(space, config.id)
        self.shape, self.dtype = self.reader.shape, self.reader.dtype
        self.unbounded = self.reader.unbounded
        self.num_actions = int(actions.n)

    def split(self, x: np.ndarray) -> np.ndarray:
        """Reshape an array from [S * N, ...] to [S, N, ...]."""
        return x.reshape(*self.rows, *x.shape[1:])

    def step_of(
        self,
        observation: Any,
        reward: np.ndarray,
        score: np.ndarray,
        terminated: np.ndarray,
        truncated: np.ndarray,
        valid: np.ndarray,
        room: np.ndarray | None = None,
    ) -> EnvStep:
        """Return the step, made from the results of all environments.

        Args:
          observation: the observations, arrays [S * N, ...], or a dict of them.
          reward: the task's reward, from which the training reward is made, [S * N].
          score: the reward of the game itself, [S * N].
          terminated: whether the task ended the episode, bool [S * N].
          truncated: whether a limit ended the episode, bool [S * N].
          valid: False where the environment was reset instead of stepped, bool [S * N].
          room: the room of Montezuma's Revenge, uint8 [S * N], or None.
        """
        if self.config.reward == "sign":
            reward = np.maximum(0, np.sign(reward))
        elif self.config.reward == "goal":
            reward = terminated & ~truncated
        return EnvStep(
            self.split(self.reader.read(observation)),
            self.split(np.asarray(reward, np.float32)),
            self.split(np.asarray(score, np.float32)),
            self.split(terminated | truncated),
            self.split(truncated),
            self.split(valid),
            None if room is None else self.split(room),
        )

    def reset(self) -> np.ndarray:
        """Reset every environment and return the first frames, [S, N, *frame]."""
        raise NotImplementedError

    def send(self, action: np.ndarray) -> None:
        """Start a step of every environment with its action, int [S, N]."""
        raise NotImplementedError

    def receive(self) -> EnvStep:
        """Wait for the end of the started step and return its result."""
        raise NotImplementedError

    def step(self, action: np.ndarray) -> EnvStep:
        """Step every environment with its action, int [S, N]."""
        self.send(action)
        return self.receive()

    def close(self) -> None:
        """Stop the environments."""
        raise NotImplementedError


class EnvpoolPool(Pool):
    """A pool of envpool environments, which run in the threads of envpool."""

    def __init__(self, config: EnvConfig, seeds: list[list[int]]):
        family_of(config.id)
        try:
            self.envs = envpool.make(
                config.id,
                env_type="gymnasium",
                num_envs=len(seeds) * len(seeds[0]),
                seed=[seed for own in seeds for seed in own],
                **config.options,
            )
        except Exception as error:  # envpool raises many types; all concern its input
            message = str(error).strip().splitlines() or [repr(error)]
            raise ConfigError(f"envpool cannot make {config.id}: {message[0]}") from None
        space, actions = self.envs.observation_space, self.envs.action_space
        super().__init__(config, len(seeds), len(seeds[0]), space, actions)
        self.rooms = config.id.startswith("MontezumaRevenge")

    def reset(self) -> np.ndarray:
        observation, _ = self.envs.reset()
        frame = self.reader.read(observation)
        if len(frame) != self.rows[0] * self.rows[1]:
            raise ConfigError(f"{self.config.id} has several players; only one can be trained")
        return self.split(frame)

    def send(self, action: np.ndarray) -> None:
        self.envs.send(np.asarray(action, np.int32).reshape(-1))

    def receive(self) -> EnvStep:
        observation, reward, terminated, truncated, info = self.envs.recv()
        room = info["ram"][:, MONTEZUMA_ROOM] if self.rooms else None
        score = cast(np.ndarray, info.get("reward", reward))
        valid = info["elapsed_step"] != 0
        return self.step_of(observation, reward, score, terminated, truncated, valid, room)

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
        except Exception as error:  # a user's environment may raise anything
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
        self.ended = np.zeros(count, bool)

    def reset(self) -> np.ndarray:
        observation, _ = self.envs.reset(seed=cast(Any, self.seeds))
        self.ended[:] = False
        return self.split(self.reader.read(observation))

    def send(self, action: np.ndarray) -> None:
        self.action = np.asarray(action, np.int64).reshape(-1) + self.first_action

    def receive(self) -> EnvStep:
        observation, reward, terminated, truncated, _ = self.envs.step(self.action)
        valid, self.ended = ~self.ended, terminated | truncated
        return self.step_of(observation, reward, reward, terminated, truncated, valid)

    def close(self) -> None:
        self.envs.close()


def make_pools(
    config: EnvConfig,
    seeds: list[int],
    num_envs: int,
    start: int = 0,
    groups: int = 1,
    local_envs: slice = slice(None),
) -> list[Pool]:
    """Return the environments of a configuration, in pools that step independently.

    Args:
      config: the task and how it is read.
      seeds: one seed per agent.
      num_envs: the number of environments of each seed.
      start: the iteration that the run starts at.
      groups: the number of pools; the random streams of the environments do not depend on it.
      local_envs: the environments of each seed that this host steps.

    Raises:
      ConfigError: the task cannot be made with these options, or cannot be trained on.
    """
    kind = EnvpoolPool if config.suite == "envpool" else GymnasiumPool
    streams = [env_seeds(seed, num_envs, start)[local_envs] for seed in seeds]
    size = len(streams[0]) // groups
    return [
        kind(config, [own[k * size : (k + 1) * size] for own in streams]) for k in range(groups)
    ]


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
