"""Collecting rollouts: the policy acts, the pools step, every frame is stored once.

With two pools the environments of one step while the policy acts on the other's.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.environments import Pool, Step
from sndjax import Actor, Decision, Experience, Rollout


class Track(NamedTuple):
    """What the log needs of a rollout beside what the learner does; arrays are [S, T, N]."""

    valid: np.ndarray
    done: np.ndarray
    reward: np.ndarray
    score: np.ndarray
    room: np.ndarray | None


def shapes(pool: Pool, stack: int, steps: int, heads: int) -> Experience:
    """The shapes and dtypes of the batches of a `Collector` of one pool."""
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


def groups_of(num_envs: int) -> int:
    """Into how many pools the environments go.

    Two where the policy acts on another device than the processor that the environments step
    on; where both are the same, each only waits for the other.
    """
    return 2 if jax.default_backend() != "cpu" and num_envs % 2 == 0 else 1


class HostFrames:
    """A rollout's frames in the memory of the processor, which is where it learns."""

    def __init__(self, shape: tuple[int, ...], dtype: Any):
        """Frames are [S, T + 1, N, *frame]."""
        self.all: Any = np.zeros(shape, dtype)

    def put(self, t: int, own: slice, frame: np.ndarray) -> Any:
        """Keep the frames of step t of some environments; they are what the policy sees."""
        self.all[:, t, own] = frame
        return self.all[:, t, own]

    def whole(self) -> Any:
        """The frames of the rollout. The next one uses their memory again."""
        return self.all


class DeviceFrames:
    """A rollout's frames where it learns: each is copied there once, to be acted on."""

    def __init__(self, shape: tuple[int, ...], place: Callable[[np.ndarray], Any]):
        """Frames are [S, T + 1, N, *frame]; `place` copies some to where they are learned from."""
        self.place = place
        self.steps: list[list[jax.Array]] = [[] for _ in range(shape[1])]

        def joined(steps):
            return jnp.stack([jnp.concatenate(groups, axis=1) for groups in steps], axis=1)

        self.joined = jax.jit(joined)

    def put(self, t: int, own: slice, frame: np.ndarray) -> Any:
        """Keep the frames of step t of some environments; they are what the policy sees."""
        if own.start == 0:
            self.steps[t] = []
        self.steps[t].append(self.place(frame))
        return self.steps[t][-1]

    def whole(self) -> Any:
        """The frames of the rollout."""
        return self.joined(self.steps)


@dataclass
class Group:
    """One pool, and what its environments stand at."""

    pool: Pool
    own: slice  # its environments among all
    frame: Any  # [S, n, *frame]
    first: np.ndarray  # [S, n]
    window: Any  # [S, stack, n, *frame], the stack before this frame


class Collector:
    """The pools with the stack and the frame that each environment stands at.

    Its buffers are used again by the next rollout: a batch must have been learned from
    before the next is collected.
    """

    def __init__(
        self,
        pools: list[Pool],
        act: Callable[..., Any],
        stack: int,
        steps: int,
        heads: int,
        place: Callable[[np.ndarray], Any] = jax.device_put,
    ):
        """Reset the pools.

        Args:
          pools: the environments of all seeds, in groups of the same size.
          act: `sndjax.act` of the agent, mapped over seeds.
          stack: frames in a stack.
          steps: T, rows of a rollout.
          heads: K, value heads.
          place: copies frames [S, n, ...] to where they are learned from.
        """
        pool = pools[0]
        seeds, size = pool.rows
        envs = size * len(pools)
        self.act, self.steps = act, steps
        shape, here = (seeds, steps + 1, envs, *pool.shape), jax.default_backend() == "cpu"
        self.frames: HostFrames | DeviceFrames = (
            HostFrames(shape, pool.dtype)
            if here and len(pools) == 1
            else DeviceFrames(shape, place)
        )
        self.groups = [
            Group(
                pool,
                slice(k * size, (k + 1) * size),
                pool.reset(),
                np.ones((seeds, size), bool),
                np.zeros((seeds, stack, size, *pool.shape), pool.dtype),
            )
            for k, pool in enumerate(pools)
        ]
        rows = (seeds, steps, envs)
        self.columns: Any = {
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

    def decide(self, k: int, actor: Actor, t: int) -> tuple[Decision, Any]:
        """What the policies do in one group at step t, and the stacks with its frame."""
        group = self.groups[k]
        group.frame = self.frames.put(t, group.own, group.frame)
        draw = np.int32(t * len(self.groups) + k)
        decision, window = self.act(actor, group.window, group.frame, group.first, draw)
        self.value[:, t, group.own] = decision.value
        return decision, window

    def begin(self, group: Group, t: int, decision: Decision, window: Any) -> None:
        """Let the environments of a group take step t."""
        group.pool.send(np.asarray(decision.executed))
        group.window = window
        columns = self.columns
        columns["action"][:, t, group.own] = decision.action
        columns["log_prob"][:, t, group.own] = decision.log_prob
        columns["first"][:, t, group.own] = group.first

    def end(self, group: Group, t: int) -> None:
        """Wait for them, and store what step t returned."""
        step: Step = group.pool.receive()
        for name in ("done", "valid", "reward", "truncated", "score"):
            self.columns[name][:, t, group.own] = getattr(step, name)
        if self.room is not None:
            self.room[:, t, group.own] = step.room
        group.frame, group.first = step.frame, ~step.valid

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
        histories = []
        for t in range(self.steps):
            for k, group in enumerate(self.groups):
                if t > 0:
                    self.end(group, t - 1)
                decision, window = self.decide(k, actor, t)
                self.begin(group, t, decision, window)
                if t == 0:
                    histories.append(window[:, :-1])
            if t > 0:
                report(t)
        for k, group in enumerate(self.groups):
            self.end(group, self.steps - 1)
            self.decide(k, actor, self.steps)  # for its value
        report(self.steps)
        history = histories[0] if len(histories) == 1 else jnp.concatenate(histories, axis=2)
        c = self.columns
        frames = self.frames.whole()
        rollout = Rollout(frames, c["action"], c["first"], c["done"], c["valid"])
        batch = Experience(rollout, history, c["reward"], c["truncated"], c["log_prob"], self.value)
        return batch, Track(c["valid"], c["done"], c["reward"], c["score"], self.room)

    def close(self) -> None:
        """Stop the environments."""
        for group in self.groups:
            group.pool.close()
