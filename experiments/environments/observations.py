"""Readers of observations: images as uint8 frames, everything else as one float32 vector."""

from typing import Any

import numpy as np

from ..config.envpool_tasks import gym
from ..config.schema import EnvConfig
from ..system.errors import ConfigError
from .image_layout import LARGE, SMALL, ImageLayout, find_layout

UNBOUNDED = 1e6  # a larger bound counts as no bound
PIXEL_RANGES = (255.0, 1.0)  # largest values of images
Path = tuple[str, ...]  # the keys that lead to a part of a Dict observation


def leaf_spaces(space: Any, path: Path = ()) -> list[tuple[Path, Any]]:
    """Return the spaces inside a dict space that are not dicts, with their paths, by name."""
    if isinstance(space, gym.spaces.Dict):
        return [leaf for k in sorted(space.spaces) for leaf in leaf_spaces(space[k], (*path, k))]
    return [(path, space)]


def leaf_value(observation: Any, path: Path) -> np.ndarray:
    """Return the part of an observation that a path leads to."""
    for key in path:
        observation = observation[key]
    return np.asarray(observation)


class ImageReader:
    """A reader of images as uint8 pixels, channels last; stacked frames become channels.

    Attributes:
      shape: [H, W, C].
      dtype: uint8.
      unbounded: empty, as pixels have bounds.
      description: how observations are read, for the user.
      doubts: what the user should know about it, one line each.
    """

    unbounded: tuple[bool, ...] = ()

    def __init__(self, path: Path, space: Any, layout: ImageLayout, largest: float):
        """Set the order of the axes.

        Args:
          path: the keys that lead to the image.
          space: its space.
          layout: the order of its axes.
          largest: the value of a white pixel.
        """
        self.path, self.layout, self.largest = path, layout, largest
        self.shape, self.dtype = layout.shape, np.uint8
        where = f" '{'.'.join(path)}'" if path else ""
        size = "x".join(map(str, self.shape))
        self.description = (
            f"image{where} {size}, {space.dtype} of 0 to {largest:g}, read as x / {largest:g}"
            f"{'' if largest == 255 else ', in 256 levels'}"
        )
        self.doubts: list[str] = []
        if layout.stacked > 1:
            self.doubts.append(
                f"{layout.stacked} stacked frames are read as {self.shape[-1]} channels, also by "
                "the intrinsic module, which in the thesis sees one frame: take the task without "
                f"its stack and env.stack={layout.stacked}"
            )

    def read(self, observation: Any) -> np.ndarray:
        image = self.layout.apply(leaf_value(observation, self.path))
        if image.dtype == np.uint8 and self.largest == 255:
            return image
        scaled = np.asarray(image, np.float32) * np.float32(255 / self.largest)
        return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)


class VectorReader:
    """A reader of all parts as one float32 vector; bounded components are scaled to [-1, 1].

    A component whose bounds are equal is constant, and becomes 0.

    Attributes:
      shape: [D].
      dtype: float32.
      unbounded: for each component, whether it has no bounds.
      description: how observations are read, for the user.
      doubts: what the user should know about it, one line each.
    """

    def __init__(self, space: Any):
        self.leaves = leaf_spaces(space)
        low, high = zip(*(self.bounds(leaf) for _, leaf in self.leaves), strict=True)
        self.sizes = [len(x) for x in low]
        low, high = np.concatenate(low), np.concatenate(high)
        unbounded = (low < -UNBOUNDED) | (high > UNBOUNDED) | (low > high)
        self.unbounded = tuple(bool(x) for x in unbounded)
        low, high = np.where(unbounded, -1, low), np.where(unbounded, 1, high)
        self.centre = ((low + high) / 2).astype(np.float32)
        self.half = np.where(high > low, (high - low) / 2, 1).astype(np.float32)
        self.shape, self.dtype = self.centre.shape, np.float32
        free = int(unbounded.sum())
        parts = [
            f"{len(low) - free} scaled from their bounds to [-1, 1]" * (free < len(low)),
            f"{free} without bounds divided by their running deviation" * (free > 0),
        ]
        self.description = f"vector of {len(low)}, {', '.join(filter(None, parts))}"
        self.doubts = [
            f"{'.'.join(path) or 'the observation'} has the shape of an image, {leaf.shape} "
            f"{leaf.dtype}, but is read as {int(np.prod(leaf.shape))} numbers: for an image take "
            f"env.observation=image{self.needed_range(leaf)}"
            for path, leaf in self.leaves
            if isinstance(leaf, gym.spaces.Box) and find_layout(leaf.shape, LARGE)
        ]

    @staticmethod
    def needed_range(space: Any) -> str:
        """Return the option that gives the largest value of an image whose bounds do not."""
        return "" if pixel_range(space) else " env.pixel_max=255 (or 1)"

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
        values = [leaf_value(observation, path) for path, _ in self.leaves]
        out = np.empty((len(values[0]), *self.shape), np.float32)
        start = 0
        for value, (_, space), size in zip(values, self.leaves, self.sizes, strict=True):
            part = out[:, start : start + size]
            if isinstance(space, gym.spaces.Discrete):
                part[:] = -1.0
                index = value.reshape(len(value)) - int(space.start)
                part[np.arange(len(value)), index] = 1.0
            else:
                part[:] = value.reshape(len(value), -1)
            start += size
        out -= self.centre
        out /= self.half
        return out


class MiniGridReader:
    """A reader of MiniGrid's view and the agent's direction as one-hot vectors.

    They are one-hot because the numbers of a grid cell are categories. The mission is not read, so
    information that only the mission contains (which of several objects) stays unknown.
    """

    unbounded: tuple[bool, ...] = ()
    kinds = (11, 6, 4)  # numbers of objects, colours and states (of a door, or a direction)
    doubts: tuple[str, ...] = ()

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
        self.description = (
            f"cells {height}x{width} and the direction, one-hot, {self.shape[0]} numbers"
        )

    def read(self, observation: Any) -> np.ndarray:
        image, direction = observation["image"], np.ravel(observation["direction"])
        planes = [np.eye(n, dtype=np.float32)[image[..., k]] for k, n in enumerate(self.kinds)]
        view = np.concatenate(planes, axis=-1).reshape(len(image), -1)
        return np.concatenate([view, np.eye(self.directions, dtype=np.float32)[direction]], axis=1)


Reader = ImageReader | VectorReader | MiniGridReader


def pixel_range(space: Any) -> float | None:
    """Return the largest value of an image, 255 or 1, from its bounds; None if they do not tell."""
    if space.dtype == np.uint8:
        return 255.0
    for largest in PIXEL_RANGES:
        if np.all(space.low == 0) and np.all(space.high == largest):
            return largest
    return None


def make_image_reader(space: Any, config: EnvConfig) -> ImageReader:
    """Return the reader of the one image of a space, for env.observation=image.

    Args:
      space: the observation space of one environment.
      config: the task, for `pixel_max`.

    Raises:
      ConfigError: there is no image, more than one, or its range is not known.
    """
    images = [
        (path, leaf, layout)
        for path, leaf in leaf_spaces(space)
        if isinstance(leaf, gym.spaces.Box) and (layout := find_layout(leaf.shape, SMALL))
    ]
    if len(images) != 1:
        raise ConfigError(
            f"env.observation=image: the observations of {config.id} have {len(images) or 'no'} "
            f"images of at least {SMALL}x{SMALL} pixels; take env.observation=vector"
        )
    ((path, leaf, layout),) = images
    largest = config.pixel_max or pixel_range(leaf)
    if largest is None:
        raise ConfigError(
            f"env.observation=image: the bounds of {config.id} do not say how bright white is; "
            "give env.pixel_max=255 or env.pixel_max=1"
        )
    return ImageReader(path, leaf, layout, largest)


def make_reader(space: Any, config: EnvConfig) -> Reader:
    """Return the reader of a task's observations.

    With env.observation=auto, a MiniGrid view is read as cells, one image whose values are 0 to 255
    or 0 to 1 as an image, and everything else as a vector.

    Args:
      space: the observation space of one environment.
      config: the task and how its observations are read.

    Raises:
      ConfigError: observations of this space cannot be read, or not in the way that is asked for.
    """
    how = config.observation
    if how == "image":
        return make_image_reader(space, config)
    cells = MiniGridReader.matches(space, config.id)
    if how == "cells" and not cells:
        raise ConfigError(f"env.observation=cells: {config.id} has no view of MiniGrid's cells")
    if cells and how != "vector":
        return MiniGridReader(space)
    if how == "auto" and isinstance(space, gym.spaces.Box):
        layout, largest = find_layout(space.shape, LARGE), config.pixel_max or pixel_range(space)
        if layout and largest:
            return ImageReader((), space, layout, largest)
    return VectorReader(space)
