"""Readers of observations: images as uint8 frames, everything else as one float32 vector."""

from typing import Any

import numpy as np

from ..config.envpool_tasks import gym
from ..system.errors import ConfigError

UNBOUNDED = 1e6  # a larger bound counts as no bound


def leaf_spaces(space: Any, path: tuple[str, ...] = ()) -> list[tuple[tuple[str, ...], Any]]:
    """Return the spaces inside a dict space that are not dicts, with their paths, by name."""
    if isinstance(space, gym.spaces.Dict):
        return [leaf for k in sorted(space.spaces) for leaf in leaf_spaces(space[k], (*path, k))]
    return [(path, space)]


class ImageReader:
    """A reader of uint8 images, channels last."""

    unbounded: tuple[bool, ...] = ()

    def __init__(self, space: Any):
        first = space.shape[0] < space.shape[-1]
        self.order = (0, 2, 3, 1) if first else (0, 1, 2, 3)
        self.shape = tuple(space.shape[axis - 1] for axis in self.order[1:])
        self.dtype = np.uint8

    def read(self, observation: np.ndarray) -> np.ndarray:
        return observation.transpose(self.order)


class VectorReader:
    """A reader of all other spaces as one float32 vector; bounded parts scaled to [-1, 1]."""

    def __init__(self, space: Any):
        self.leaves = leaf_spaces(space)
        low, high = zip(*(self.bounds(leaf) for _, leaf in self.leaves), strict=True)
        low, high = np.concatenate(low), np.concatenate(high)
        unbounded = (low < -UNBOUNDED) | (high > UNBOUNDED) | (low >= high)
        self.unbounded = tuple(bool(x) for x in unbounded)
        low, high = np.where(unbounded, -1, low), np.where(unbounded, 1, high)
        self.centre = ((low + high) / 2).astype(np.float32)
        self.half = ((high - low) / 2).astype(np.float32)
        self.shape, self.dtype = self.centre.shape, np.float32

    @staticmethod
    def bounds(space: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and the upper bound of each component of a space.

        Raises:
          ConfigError: observations of this space cannot be read.
        """
        if isinstance(space, gym.spaces.Discrete):  # one-hot
            return -np.ones(int(space.n)), np.ones(int(space.n))
        if isinstance(space, gym.spaces.MultiBinary):
            size = int(np.prod(space.shape))
            return np.zeros(size), np.ones(size)
        if not isinstance(space, gym.spaces.Box):
            raise ConfigError(
                f"observations of {type(space).__name__} cannot be read; only Box, Discrete, "
                "MultiBinary and Dict of these"
            )
        return space.low.astype(np.float64).ravel(), space.high.astype(np.float64).ravel()

    def read(self, observation: Any) -> np.ndarray:
        parts = []
        for path, space in self.leaves:
            value = observation
            for key in path:
                value = value[key]
            value = np.asarray(value)
            if isinstance(space, gym.spaces.Discrete):
                index = value.reshape(len(value)) - int(space.start)
                value = 2.0 * np.eye(int(space.n), dtype=np.float32)[index] - 1.0
            parts.append(value.reshape(len(value), -1).astype(np.float32))
        return (np.concatenate(parts, axis=1) - self.centre) / self.half


class MiniGridReader:
    """A reader of MiniGrid's view and the agent's direction as one-hot vectors.

    They are one-hot because the numbers of a grid cell are categories. The mission is not read, so
    information that only the mission contains (which of several objects) stays unknown.
    """

    unbounded: tuple[bool, ...] = ()
    kinds = (11, 6, 4)  # numbers of objects, colours and states (of a door, or a direction)

    @staticmethod
    def matches(space: Any, task: str) -> bool:
        """Return True if the space is a MiniGrid view.

        BabyAI has the same space, but is excluded, because its mission states the goal.
        """
        if not isinstance(space, gym.spaces.Dict) or "BabyAI" in task:
            return False
        image, direction = space.spaces.get("image"), space.spaces.get("direction")
        small = (
            isinstance(image, gym.spaces.Box) and image.shape[2:] == (3,) and image.shape[0] < 32
        )
        return small and isinstance(direction, gym.spaces.Discrete) and "mission" in space.spaces

    def __init__(self, space: Any):
        height, width, _ = space["image"].shape
        self.directions = int(space["direction"].n)
        self.shape = (height * width * sum(self.kinds) + self.directions,)
        self.dtype = np.float32

    def read(self, observation: Any) -> np.ndarray:
        image, direction = observation["image"], np.ravel(observation["direction"])
        planes = [np.eye(n, dtype=np.float32)[image[..., k]] for k, n in enumerate(self.kinds)]
        view = np.concatenate(planes, axis=-1).reshape(len(image), -1)
        return np.concatenate([view, np.eye(self.directions, dtype=np.float32)[direction]], axis=1)


def make_reader(space: Any, task: str) -> ImageReader | VectorReader | MiniGridReader:
    """Return the reader of a task's observations.

    Args:
      space: the observation space of one environment.
      task: the name of the task.

    Raises:
      ConfigError: observations of this space cannot be read.
    """
    if (
        isinstance(space, gym.spaces.Box)
        and space.dtype == np.uint8
        and len(space.shape) == 3
        and sorted(space.shape)[1] >= 32
    ):
        return ImageReader(space)
    return MiniGridReader(space) if MiniGridReader.matches(space, task) else VectorReader(space)
