"""A task whose episodes never end, for tests of what waits for an episode's end."""

import gymnasium as gym
import numpy as np


class Endless(gym.Env):
    """A counter; the episodes of the first environment may end after `ends_after` steps."""

    made = 0

    def __init__(self, image=False, ends_after=0):
        """Set the kind of observation, and the length of the first environment's episodes."""
        self.image, self.at = image, 0
        self.ends_after = ends_after if Endless.made == 0 else 0
        Endless.made += 1
        self.action_space = gym.spaces.Discrete(2)
        self.observation_space = (
            gym.spaces.Box(0, 255, (64, 64, 3), np.uint8)
            if image
            else gym.spaces.Box(0.0, 1.0, (4,), np.float32)
        )

    def look(self):
        """Return the observation: four bits of the counter, or a grey image."""
        if self.image:
            return np.full((64, 64, 3), self.at % 256, np.uint8)
        return np.array([self.at >> k & 1 for k in range(4)], np.float32)

    def reset(self, *, seed=None, options=None):
        """Begin an episode."""
        super().reset(seed=seed)
        self.at = 0
        return self.look(), {}

    def step(self, action):
        """Count one step, with reward 1."""
        self.at += 1
        return self.look(), 1.0, bool(self.ends_after) and self.at >= self.ends_after, False, {}


gym.register("Endless-v0", entry_point=Endless)
