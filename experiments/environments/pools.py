"""One pool of envpool environments for all seeds of a run, read as frames."""

import sys
from typing import Any, NamedTuple, cast

import numpy as np

from ..config.envpool_tasks import envpool, family_of, gym
from ..config.schema import EnvConfig
from ..config.validation import unknown_name_error
from ..system.errors import ConfigError
from .observations import make_reader

MONTEZUMA_ROOM = 3  # the byte of RAM that numbers the room


class EnvStep(NamedTuple):
    """What one step of every environment returned; all arrays are [S, N, ...]."""

    frame: np.ndarray  # the newest observation; an episode's true last one where done
    reward: np.ndarray  # float32, the training reward
    score: np.ndarray  # float32, the game's own
    done: np.ndarray
    truncated: np.ndarray
    valid: np.ndarray  # False where the environment reset itself instead
    room: np.ndarray | None  # uint8, in Montezuma's Revenge


def env_seeds(seed: int, num_envs: int, start: int) -> list[int]:
    """One seed per environment, hashed from the run's seed and the iteration it starts at.

    A resumed run therefore begins fresh streams, and seeds k and k + 1 share none.
    """
    return [
        int(np.random.SeedSequence([seed, env, start]).generate_state(1)[0] & 0x7FFFFFFF)
        for env in range(num_envs)
    ]


class Pool:
    """S x N environments of one task, stepped together.

    A reset takes a step of its own, in which the action is ignored: that row is not valid.

    Attributes:
      num_actions: A.
      shape, dtype: of one frame: uint8 [H, W, C] or float32 [D].
      unbounded: which components of a vector have no bounds.
      rooms: whether steps tell the room of Montezuma's Revenge.
    """

    rooms = False

    def __init__(self, config: EnvConfig, seeds: int, num_envs: int, space: Any, actions: Any):
        """Take in the spaces of one environment."""
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
        """From [S * N, ...] to [S, N, ...]."""
        return x.reshape(*self.rows, *x.shape[1:])

    def step_of(
        self, observation, reward, score, terminated, truncated, valid, room=None
    ) -> EnvStep:
        """A step from what all environments returned, [S * N, ...] each."""
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
        """The first frame of every environment, [S, N, *frame]."""
        raise NotImplementedError

    def send(self, action: np.ndarray) -> None:
        """Begin to step every environment with its action, int [S, N]."""
        raise NotImplementedError

    def receive(self) -> EnvStep:
        """What the step that was begun returned, when it is over."""
        raise NotImplementedError

    def step(self, action: np.ndarray) -> EnvStep:
        """Step every environment with its action, int [S, N]."""
        self.send(action)
        return self.receive()

    def close(self) -> None:
        """Stop the environments."""
        raise NotImplementedError


class EnvpoolPool(Pool):
    """Environments of envpool, in its own threads."""

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
        except Exception as error:  # envpool raises many kinds; all are about its input
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
        score, valid = info.get("reward", reward), info["elapsed_step"] != 0
        return self.step_of(observation, reward, score, terminated, truncated, valid, room)

    def close(self) -> None:
        self.envs.close()


class GymnasiumPool(Pool):
    """Environments of `gymnasium.make_vec`, the user's own among them."""

    def __init__(self, config: EnvConfig, seeds: list[list[int]]):
        count = len(seeds) * len(seeds[0])
        if "" not in sys.path:
            sys.path.insert(0, "")  # env.id=my_file:MyTask-v0 is looked for here first
        try:
            # Not a task's own vector form: those differ in what they take and how they reset.
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
    """The environments of a configuration, in groups that step apart from each other.

    Args:
      config: the task and how it is read.
      seeds: one per agent.
      num_envs: environments of each.
      start: the iteration the run starts at.
      groups: in how many pools; the streams of the environments do not depend on it.
      local_envs: the environments of each seed that this host steps.

    Raises:
      ConfigError: this task cannot be made with these options, or not be trained on.
    """
    kind = EnvpoolPool if config.suite == "envpool" else GymnasiumPool
    streams = [env_seeds(seed, num_envs, start)[local_envs] for seed in seeds]
    size = len(streams[0]) // groups
    return [
        kind(config, [own[k * size : (k + 1) * size] for own in streams]) for k in range(groups)
    ]


def make_pool(config: EnvConfig, seeds: list[int], num_envs: int, start: int = 0) -> Pool:
    """All of them in one group. See `make_pools`."""
    (pool,) = make_pools(config, seeds, num_envs, start)
    return pool
