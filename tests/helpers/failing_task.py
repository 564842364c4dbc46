"""A task whose code fails after some steps, for tests of what is left of a run then."""

import gymnasium as gym

from helpers.endless_task import Endless


class Failing(Endless):
    """The endless counter, which raises an error when it has counted so far."""

    def __init__(self, at=40):
        """Set the step that fails."""
        super().__init__()
        self.fails_at = at

    def step(self, action):
        """Count one step, or fail."""
        if self.at + 1 >= self.fails_at:
            raise RuntimeError("the simulator is gone")
        return super().step(action)


gym.register("Failing-v0", entry_point=Failing)
