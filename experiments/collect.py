"""Collecting rollouts: the policy acts, the pool steps, every frame is stored once."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.environments import Pool
from sndjax import Actor, Experience, Rollout


class Track(NamedTuple):
    """What the log needs of a rollout beside what the learner does; arrays are [S, T, N]."""

    score: np.ndarray
    room: np.ndarray | None


def shapes(pool: Pool, stack: int, steps: int, heads: int) -> Experience:
    """The shapes and dtypes of the batches of a `Collector`."""
    seeds, envs = pool.rows
    array: Any = lambda dtype, *shape: jax.ShapeDtypeStruct((seeds, *shape), dtype)
    row: Any = lambda dtype: array(dtype, steps, envs)
    frames = array(pool.dtype, steps + 1, envs, *pool.shape)
    rollout = Rollout(frames, row(np.int32), row(bool), row(bool), row(bool))
    return Experience(
        rollout,
        array(pool.dtype, stack - 1, envs, *pool.shape),
        row(np.float32),
        row(bool),
        row(np.float32),
        array(np.float32, steps + 1, envs, heads),
    )


class Collector:
    """The pool with the stack and the frame that each environment stands at.

    Its buffers are used again by the next rollout: a batch must have been learned from
    before the next is collected.
    """

    def __init__(self, pool: Pool, act: Callable[..., Any], stack: int, steps: int, heads: int):
        """Reset the pool.

        Args:
          pool: the environments of all seeds.
          act: `sndjax.act` of the agent, mapped over seeds.
          stack: frames in a stack.
          steps: T, rows of a rollout.
          heads: K, value heads.
        """
        seeds, envs = pool.rows
        self.pool, self.act, self.steps = pool, act, steps
        self.frames: Any = np.zeros((seeds, steps + 1, envs, *pool.shape), pool.dtype)
        self.frames[:, steps] = pool.reset()
        self.first = np.ones((seeds, envs), bool)
        self.window: jax.Array | np.ndarray = np.zeros(
            (seeds, stack, envs, *pool.shape), pool.dtype
        )
        rows = (seeds, steps, envs)
        self.columns = {
            "action": np.zeros(rows, np.int32),
            "first": np.zeros(rows, bool),
            "done": np.zeros(rows, bool),
            "valid": np.zeros(rows, bool),
            "reward": np.zeros(rows, np.float32),
            "truncated": np.zeros(rows, bool),
            "log_prob": np.zeros(rows, np.float32),
            "score": np.zeros(rows, np.float32),
        }
        self.value: Any = np.zeros((seeds, steps + 1, envs, heads), np.float32)
        self.room: Any = np.zeros(rows, np.uint8) if pool.rooms else None

    def collect(
        self, actor: Actor, report: Callable[[int], None] = lambda step: None
    ) -> tuple[Experience, Track]:
        """One rollout of every seed.

        Args:
          actor: the policies, leaves [S, ...].
          report: called with the number of steps taken so far.

        Returns:
          The batch for `train_step`, leaves [S, ...], and what the log needs.
        """
        c: Any = self.columns
        self.frames[:, 0] = self.frames[:, self.steps]
        history: Any = None
        for t in range(self.steps):
            decision, self.window = self.act(
                actor, self.window, self.frames[:, t], self.first, np.int32(t)
            )
            if history is None:
                history = self.window[:, :-1]
            step = self.pool.step(np.asarray(decision.executed))
            self.frames[:, t + 1] = step.frame
            c["action"][:, t] = decision.action
            c["log_prob"][:, t] = decision.log_prob
            self.value[:, t] = decision.value
            c["first"][:, t] = self.first
            for name in ("done", "valid", "reward", "truncated", "score"):
                c[name][:, t] = getattr(step, name)
            if self.room is not None:
                self.room[:, t] = step.room
            self.first = ~step.valid
            report(t + 1)
        last, _ = self.act(
            actor, self.window, self.frames[:, self.steps], self.first, np.int32(self.steps)
        )
        self.value[:, self.steps] = last.value
        rollout = Rollout(self.frames, c["action"], c["first"], c["done"], c["valid"])
        batch = Experience(rollout, history, c["reward"], c["truncated"], c["log_prob"], self.value)
        return batch, Track(c["score"], self.room)
