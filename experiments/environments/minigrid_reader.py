"""A reader of MiniGrid's view, whose numbers are categories."""

from typing import Any

import numpy as np

from ..config.envpool_tasks import gym


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

    def read(self, observation: Any) -> Any:
        image, direction = observation["image"], observation["direction"]
        xp = image.__array_namespace__()
        kinds = enumerate(self.kinds)
        planes = [xp.eye(n, dtype=np.float32)[image[..., k]] for k, n in kinds]
        view = xp.concatenate(planes, axis=-1).reshape(len(image), -1)
        facing = xp.eye(self.directions, dtype=np.float32)[direction.reshape(-1)]
        return xp.concatenate([view, facing], axis=1)
