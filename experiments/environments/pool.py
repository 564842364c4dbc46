"""The environments of one task, stepped together: what the suites have in common."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from sndjax import JaxEnvironment

from ..config.envpool_tasks import gym
from ..config.schema import EnvConfig
from ..system.errors import ConfigError, TaskError
from .observations import make_reader


class EnvStep(NamedTuple):
    """The result of one step of every environment; all arrays are [S, N, ...]."""

    frame: np.ndarray  # the newest observation; where done, the true last one of the episode
    reward: np.ndarray  # float32, the training reward
    score: np.ndarray  # float32, the reward of the game itself
    done: np.ndarray  # the episode that is learned from ended
    game_over: np.ndarray  # the game ended: not where only a life was lost (episodic_life)
    truncated: np.ndarray  # done by a limit alone, and not by the task
    valid: np.ndarray  # False where the environment was reset instead of stepped
    room: np.ndarray | None  # uint8, in Montezuma's Revenge


@contextmanager
def task_errors(task: str) -> Iterator[None]:
    """Turn whatever the code of an environment raises into a TaskError.

    Raises:
      TaskError: the environment raised an exception, or tried to end the process.
    """
    try:
        yield
    except KeyboardInterrupt:  # of the user, where no handler is set
        raise
    except BaseException as error:
        raise TaskError(task, error) from error


def training_reward(config: EnvConfig, reward: Any, terminated: Any) -> Any:
    """Return the reward that is learned from, an array of NumPy or of jax.

    Args:
      config: the task, with the kind of reward.
      reward: of the task.
      terminated: whether the task ended the episode.
    """
    xp = reward.__array_namespace__()
    if config.reward == "sign":
        return xp.maximum(0, xp.sign(reward))
    return terminated if config.reward == "goal" else reward


class Pool:
    """S x N environments of one task, stepped together.

    A reset takes one separate step, in which the action is ignored: the row after one that ended
    an episode, in every suite. That row is not valid.

    Attributes:
      num_actions: the number of actions A.
      shape: the shape of one frame, [H, W, C] or [D].
      dtype: the dtype of one frame, uint8 for [H, W, C] or float32 for [D].
      unbounded: for each component of a vector, whether it has no bounds.
      rooms: whether steps contain the room of Montezuma's Revenge.
      environment: the environment with its observations read as frames, if it lives in JAX: then
        training steps it inside its own program.
    """

    rooms = False
    environment: JaxEnvironment | None = None

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
        self.reader = make_reader(space, config)
        self.shape, self.dtype = self.reader.shape, self.reader.dtype
        self.unbounded = self.reader.unbounded
        self.num_actions = int(actions.n)
        self.ended = np.zeros(seeds * num_envs, bool)

    def first_frames(self, observation: Any) -> np.ndarray:
        """Return the first frames of all environments, [S, N, *frame].

        Raises:
          ConfigError: an environment has several players.
        """
        self.ended[:] = False
        frame = self.reader.read(observation)
        if len(frame) != len(self.ended):
            raise ConfigError(f"{self.config.id} has several players; only one can be trained")
        return self.split(frame)

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
        game_over: np.ndarray | None = None,
        room: np.ndarray | None = None,
    ) -> EnvStep:
        """Return the step, made from the results of all environments.

        An episode that its task and a limit end in the same step is terminated, not truncated.

        Args:
          observation: the observations, arrays [S * N, ...], or a dict of them.
          reward: the task's reward, from which the training reward is made, [S * N].
          score: the reward of the game itself, [S * N].
          terminated: whether the task ended the episode, bool [S * N].
          truncated: whether a limit ended the episode, bool [S * N].
          game_over: whether the game ended, where an episode may be less, bool [S * N].
          room: the room of Montezuma's Revenge, uint8 [S * N], or None.
        """
        done, valid = terminated | truncated, ~self.ended
        self.ended = done
        reward = training_reward(self.config, reward, terminated)
        return EnvStep(
            frame=self.split(self.reader.read(observation)),
            reward=self.split(np.asarray(reward, np.float32)),
            score=self.split(np.asarray(score, np.float32)),
            done=self.split(done),
            game_over=self.split(done if game_over is None else done & game_over),
            truncated=self.split(truncated & ~terminated),
            valid=self.split(valid),
            room=None if room is None else self.split(room),
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

    def draw(self) -> np.ndarray:
        """Return an image of the state of the first environment, uint8 [H, W, 3].

        Raises:
          ConfigError: the task has no images.
        """
        raise ConfigError(f"{self.config.id} cannot be drawn")

    def close(self) -> None:
        """Stop the environments."""
        raise NotImplementedError
