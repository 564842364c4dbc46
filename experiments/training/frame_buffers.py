"""The frames of a rollout: in host memory, or on the device that learns."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


class HostFrames:
    """The frames of a rollout in host memory, for learning on the CPU."""

    def __init__(self, shape: tuple[int, ...], dtype: Any):
        """Allocate frames [S, T + 1, N, *frame]."""
        self.buffer: Any = np.zeros(shape, dtype)

    def put(self, t: int, envs: slice, frame: np.ndarray) -> Any:
        """Store the frames of one step of some environments.

        Args:
          t: the step.
          envs: the environments.
          frame: their frames, [S, n, *frame].

        Returns:
          The frames as the policy gets them.
        """
        self.buffer[:, t, envs] = frame
        return self.buffer[:, t, envs]

    def stacked(self) -> Any:
        """Return the frames of the rollout. The next rollout reuses their memory."""
        return self.buffer


class DeviceFrames:
    """The frames of a rollout on the device that learns: acting and learning share one copy."""

    def __init__(self, shape: tuple[int, ...], place: Callable[[np.ndarray], Any]):
        """Start without frames.

        Args:
          shape: the shape of all frames, [S, T + 1, N, *frame].
          place: a function that copies frames to the devices that learn.
        """
        self.place = place
        self.steps: list[list[jax.Array]] = [[] for _ in range(shape[1])]

        def join(steps: list[list[jax.Array]]) -> jax.Array:
            return jnp.stack([jnp.concatenate(groups, axis=1) for groups in steps], axis=1)

        self.join = jax.jit(join)

    def put(self, t: int, envs: slice, frame: np.ndarray) -> Any:
        """Copy the frames of one step of some environments to the devices that learn.

        Args:
          t: the step.
          envs: the environments.
          frame: their frames, [S, n, *frame].

        Returns:
          The frames as the policy gets them.
        """
        if envs.start == 0:
            self.steps[t] = []
        self.steps[t].append(self.place(frame))
        return self.steps[t][-1]

    def stacked(self) -> Any:
        """Return the frames of the rollout."""
        return self.join(self.steps)
