"""An environment that waits instead of computing, as a robot or a remote simulator does.

python -m experiments.run env=gymnasium env.id=examples.slow_environment:Slow-v0 algo=snd_vic \
    num_envs=8 env.options.seconds=0.001 network=wide total_steps=20480 overlap=1
"""

import time

import gymnasium as gym

from examples.own_environment import LENGTH, Corridor


class Slow(Corridor):
    """The corridor of `own_environment`, whose every step takes some time of the clock."""

    def __init__(self, seconds: float = 0.001):
        """Set how long a step takes; environments step one after another."""
        super().__init__()
        self.seconds = seconds

    def step(self, action):
        """Wait, then move."""
        time.sleep(self.seconds)
        return super().step(action)


gym.register("Slow-v0", entry_point=Slow, max_episode_steps=2 * LENGTH)
