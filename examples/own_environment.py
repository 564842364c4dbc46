"""A new environment in one file, used through gymnasium.make_vec.

python -m experiments.run env=gymnasium env.id=examples.own_environment:Corridor-v0 \
    algo=snd_vic algo.reward_scale=running_std
"""

import gymnasium as gym
import numpy as np

LENGTH = 30


class Corridor(gym.Env):
    """A corridor with reward 1 only at the far end. The observation is a vector or an image."""

    def __init__(self, image: bool = False):
        self.image, self.at = image, 0
        self.action_space = gym.spaces.Discrete(2)
        self.observation_space = (
            gym.spaces.Box(0, 255, (64, 64, 3), np.uint8)
            if image
            else gym.spaces.Box(0.0, 1.0, (LENGTH,), np.float32)
        )

    def look(self):
        """Return the observation: a one-hot vector, or a red column on black."""
        if not self.image:
            return np.eye(LENGTH, dtype=np.float32)[self.at]
        picture = np.zeros((64, 64, 3), np.uint8)
        picture[:, 2 * self.at : 2 * self.at + 2, 0] = 255
        return picture

    def reset(self, *, seed=None, options=None):
        """Move back to the near end, and return the observation and no further information."""
        super().reset(seed=seed)
        self.at = 0
        return self.look(), {}

    def step(self, action):
        """Move one cell to the left or to the right."""
        self.at = int(np.clip(self.at + 2 * action - 1, 0, LENGTH - 1))
        end = self.at == LENGTH - 1
        return self.look(), float(end), end, False, {}


gym.register("Corridor-v0", entry_point=Corridor, max_episode_steps=60)
