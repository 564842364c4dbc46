"""Readers of observations: images as uint8 frames, everything else as one float32 vector."""

from typing import Any

import numpy as np

from ..config.envpool_tasks import gym
from ..config.schema import EnvConfig
from ..system.errors import ConfigError
from .image_layout import LARGE, SMALL, ImageLayout, find_layout
from .minigrid_reader import MiniGridReader

UNBOUNDED = 1e6  # a larger bound counts as no bound
PIXEL_RANGES = (255.0, 1.0)  # largest values of images
Path = tuple[str, ...]  # the keys that lead to a part of a Dict observation


def leaf_spaces(space: Any, path: Path = ()) -> list[tuple[Path, Any]]:
    """Return the spaces inside a dict space that are not dicts, with their paths, by name."""
    if isinstance(space, gym.spaces.Dict):
        return [leaf for k in sorted(space.spaces) for leaf in leaf_spaces(space[k], (*path, k))]
    return [(path, space)]


def leaf_value(observation: Any, path: Path) -> Any:
    """Return the part of an observation that a path leads to, an array of NumPy or of jax."""
    for key in path:
        observation = observation[key]
    return observation if hasattr(observation, "__array_namespace__") else np.asarray(observation)


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
        self.seen = False  # whether an image was read
        self.doubts: list[str] = []
        if len(space.shape) == 2 and np.issubdtype(space.dtype, np.floating):
            self.doubts.append(
                f"a matrix of shape {space.shape} is read as a gray image in 256 levels: for "
                "numbers take env.observation=vector"
            )
        if layout.stacked > 1:
            self.doubts.append(
                f"{layout.stacked} stacked frames are read as {self.shape[-1]} channels, also by "
                "the intrinsic module, which in the thesis sees one frame: take the task without "
                f"its stack and env.stack={layout.stacked}"
            )

    def read(self, observation: Any) -> Any:
        image = self.layout.apply(leaf_value(observation, self.path))
        if image.dtype == np.uint8 and self.largest == 255:
            return image
        xp = image.__array_namespace__()
        scaled = image.astype(np.float32) * np.float32(255 / self.largest)
        if isinstance(image, np.ndarray):
            self.check_numbers(image, scaled)
        return xp.clip(xp.rint(scaled), 0, 255).astype(np.uint8)

    def check_numbers(self, image: np.ndarray, scaled: np.ndarray) -> None:
        """Check the numbers of images; the first of a run may show that its bounds are wrong.

        Args:
          image: the images as they were given.
          scaled: with 255 for white.

        Raises:
          ValueError: a number is not finite.
        """
        if not np.isfinite(scaled).all():
            raise ValueError("an image holds numbers that are not finite")
        if self.seen:
            return
        self.seen = True
        if self.largest == 255 and np.issubdtype(image.dtype, np.floating) and image.max() <= 1:
            self.doubts.append(
                f"the first image holds no number above {image.max():g}, and its bounds say "
                "255: for images of 0 to 1 take env.observation=image env.pixel_max=1"
            )


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
        codes = sum(
            size
            for (_, leaf), size in zip(self.leaves, self.sizes, strict=True)
            if isinstance(leaf, gym.spaces.MultiDiscrete)
        )
        free, constant = int(unbounded.sum()), int((low == high).sum())
        bounded = len(low) - free - constant - codes
        parts = [
            f"{codes} that are categories, one-hot" * (codes > 0),
            f"{bounded} scaled from their bounds to [-1, 1]" * (bounded > 0),
            f"{constant} constant and read as 0" * (constant > 0),
            f"{free} without bounds divided by their running deviation" * (free > 0),
        ]
        self.description = f"vector of {len(low)}, {', '.join(filter(None, parts))}"
        self.doubts = self.doubtful_images()

    def doubtful_images(self) -> list[str]:
        """Return a line for each part that has the shape of an image, but is read as numbers."""
        images = [(path, leaf) for path, leaf in self.leaves if image_layout(leaf, LARGE)]
        if len(images) == 1:
            _, leaf = images[0]
            high = float(leaf.high.max())
            known = f"{high:g}" if high < UNBOUNDED else "255 (or 1)"
            more = "" if pixel_range(leaf) else f" env.pixel_max={known}"
            advice = f"for an image take env.observation=image{more}"
        else:
            advice = "to read one as an image, give the task a wrapper that keeps only this"
        return [
            f"{'.'.join(path) or 'the observation'} has the shape of an image, {leaf.shape} "
            f"{leaf.dtype}, but is read as {int(np.prod(leaf.shape))} numbers: {advice}"
            for path, leaf in images
        ]

    @staticmethod
    def bounds(space: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and the upper bound of each component of a space.

        Raises:
          ConfigError: observations of this space cannot be read.
        """
        if isinstance(space, gym.spaces.Discrete):  # one-hot
            return -np.ones(int(space.n)), np.ones(int(space.n))
        if isinstance(space, gym.spaces.MultiDiscrete):  # one-hot, of 0 and 1
            size = int(space.nvec.sum())
            return -np.ones(size), np.ones(size)
        if isinstance(space, gym.spaces.MultiBinary):
            size = int(np.prod(space.shape))
            return np.zeros(size), np.ones(size)
        if not isinstance(space, gym.spaces.Box):
            raise ConfigError(
                f"observations of {type(space).__name__} cannot be read; only Box, Discrete, "
                "MultiDiscrete, MultiBinary and Dict of these, or with env.observation=image an "
                "image among others"
            )
        return space.low.astype(np.float64).ravel(), space.high.astype(np.float64).ravel()

    def read(self, observation: Any) -> Any:
        values = [leaf_value(observation, path) for path, _ in self.leaves]
        xp = values[0].__array_namespace__()
        parts = [
            self.read_part(value, space)
            for value, (_, space) in zip(values, self.leaves, strict=True)
        ]
        return (xp.concatenate(parts, axis=1) - self.centre[None]) / self.half[None]

    @staticmethod
    def read_part(value: Any, space: Any) -> Any:
        """Return a part of observations [B, ...] as vectors, float32[B, D].

        Args:
          value: an array of NumPy or of jax.
          space: its space.
        """
        value = value.reshape(len(value), -1)
        if isinstance(space, gym.spaces.Discrete):
            here = value - int(space.start) == np.arange(int(space.n))[None]
            return here.astype(np.float32) * 2 - 1
        if isinstance(space, gym.spaces.MultiDiscrete):
            sizes, start = space.nvec.ravel(), space.start.ravel()
            codes = np.concatenate([np.arange(n) for n in sizes]) + np.repeat(start, sizes)
            return (value[:, np.repeat(np.arange(len(sizes)), sizes)] == codes[None]).astype(
                np.float32
            )
        return value.astype(np.float32)


Reader = ImageReader | VectorReader | MiniGridReader


def image_layout(space: Any, side: int) -> ImageLayout | None:
    """Return the layout of a space that has the shape of an image, or None.

    Args:
      space: any space.
      side: the smallest height and width.
    """
    return find_layout(space.shape, side) if isinstance(space, gym.spaces.Box) else None


def pixel_range(space: Any) -> float | None:
    """Return the largest value of an image, 255 or 1, from its bounds; None if they do not tell."""
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
        if (layout := image_layout(leaf, SMALL))
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

    With env.observation=auto, a MiniGrid view is read as cells, one image whose bounds are 0 to 255
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
    reader: Reader | None = None
    if cells and how != "vector":
        reader = MiniGridReader(space)
    elif how == "auto" and (layout := image_layout(space, LARGE)):
        largest = config.pixel_max or pixel_range(space)
        reader = ImageReader((), space, layout, largest) if largest else None
    if config.pixel_max is not None and not isinstance(reader, ImageReader):
        raise ConfigError(
            f"env.pixel_max: the observations of {config.id} are not read as an image; for the "
            "image among them take env.observation=image"
        )
    return reader or VectorReader(space)
