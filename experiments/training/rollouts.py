"""Collecting rollouts: the policy acts, the pools step, every frame is stored once.

With two pools the environments of one step while the policy acts on the other's.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sndjax import Actor, ActOutput, Experience, Rollout

from ..config.schema import Config
from ..environments.pools import EnvStep, Pool


class RolloutInfo(NamedTuple):
    """What the log needs of a rollout beside what the learner does; arrays are [S, T, N]."""

    valid: np.ndarray
    done: np.ndarray
    reward: np.ndarray
    score: np.ndarray
    room: np.ndarray | None


def experience_spec(config: Config, pool: Pool, value_heads: int) -> Experience:
    """Return the shapes and dtypes of the batches that a run collects.

    Args:
      config: its seeds, environments, rollout length and stack.
      pool: any pool of its environment, for the shape and dtype of frames.
      value_heads: K, of the policy.
    """
    seeds, envs, steps = config.num_seeds, config.num_envs, config.rollout_length
    array: Any = lambda dtype, *shape: jax.ShapeDtypeStruct((seeds, *shape), dtype)
    row: Any = lambda dtype: array(dtype, steps, envs)
    rollout = Rollout(
        frames=array(pool.dtype, steps + 1, envs, *pool.shape),
        action=row(np.int32),
        first=row(bool),
        done=row(bool),
        valid=row(bool),
    )
    return Experience(
        rollout=rollout,
        history=array(pool.dtype, config.env.stack - 1, envs, *pool.shape),
        reward=row(np.float32),
        truncated=row(bool),
        log_prob=row(np.float32),
        value=array(np.float32, steps + 1, envs, value_heads),
    )


def choose_num_pools(num_envs: int) -> int:
    """Return into how many pools the environments go.

    Two where the policy acts on another device than the processor that the environments step
    on; where both are the same, each only waits for the other.
    """
    return 2 if jax.default_backend() != "cpu" and num_envs % 2 == 0 else 1


class HostFrames:
    """A rollout's frames in the memory of the processor, which is where it learns."""

    def __init__(self, shape: tuple[int, ...], dtype: Any):
        """Allocate frames [S, T + 1, N, *frame]."""
        self.buffer: Any = np.zeros(shape, dtype)

    def put(self, t: int, envs: slice, frame: np.ndarray) -> Any:
        """Store the frames of step t of some environments; return them as the policy sees them."""
        self.buffer[:, t, envs] = frame
        return self.buffer[:, t, envs]

    def stacked(self) -> Any:
        """Return the frames of the rollout. The next one uses their memory again."""
        return self.buffer


class DeviceFrames:
    """A rollout's frames where it learns: each is copied there once, to be acted on."""

    def __init__(self, shape: tuple[int, ...], place: Callable[[np.ndarray], Any]):
        """Start without frames.

        Args:
          shape: of all frames, [S, T + 1, N, *frame].
          place: copies some of them to where they are learned from.
        """
        self.place = place
        self.steps: list[list[jax.Array]] = [[] for _ in range(shape[1])]

        def join(steps: list[list[jax.Array]]) -> jax.Array:
            return jnp.stack([jnp.concatenate(groups, axis=1) for groups in steps], axis=1)

        self.join = jax.jit(join)

    def put(self, t: int, envs: slice, frame: np.ndarray) -> Any:
        """Copy the frames of step t of some environments; return them as the policy sees them."""
        if envs.start == 0:
            self.steps[t] = []
        self.steps[t].append(self.place(frame))
        return self.steps[t][-1]

    def stacked(self) -> Any:
        """Return the frames of the rollout."""
        return self.join(self.steps)


@dataclass
class PoolState:
    """One pool, and where its environments are."""

    pool: Pool
    envs: slice  # its environments among all
    frame: Any  # [S, n, *frame], the newest
    first: np.ndarray  # [S, n], frame opens an episode
    window: Any  # [S, stack, n, *frame], the stack before this frame


class Collector:
    """The pools with the stack and the newest frame of each environment.

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
        self.policy_act, self.steps = act, steps
        shape, here = (seeds, steps + 1, envs, *pool.shape), jax.default_backend() == "cpu"
        self.frames: HostFrames | DeviceFrames = (
            HostFrames(shape, pool.dtype)
            if here and len(pools) == 1
            else DeviceFrames(shape, place)
        )
        self.pool_states = [
            PoolState(
                pool=pool,
                envs=slice(k * size, (k + 1) * size),
                frame=pool.reset(),
                first=np.ones((seeds, size), bool),
                window=np.zeros((seeds, stack, size, *pool.shape), pool.dtype),
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

    def act(self, k: int, actor: Actor, t: int) -> tuple[ActOutput, Any]:
        """Let the policies act at step t in pool k.

        Returns:
          What they did, and the stacks with the newest frame.
        """
        state = self.pool_states[k]
        state.frame = self.frames.put(t, state.envs, state.frame)
        step = np.int32(t * len(self.pool_states) + k)
        output, window = self.policy_act(actor, state.window, state.frame, state.first, step)
        self.value[:, t, state.envs] = output.value
        return output, window

    def send_actions(self, state: PoolState, t: int, output: ActOutput, window: Any) -> None:
        """Start step t of a pool's environments, and store what the policies did.

        Args:
          state: of the pool.
          t: the step.
          output: what the policies did.
          window: the stacks that they saw.
        """
        state.pool.send(np.asarray(output.executed))
        state.window = window
        columns = self.columns
        columns["action"][:, t, state.envs] = output.action
        columns["log_prob"][:, t, state.envs] = output.log_prob
        columns["first"][:, t, state.envs] = state.first

    def receive_steps(self, state: PoolState, t: int) -> None:
        """Wait for step t of a pool's environments, and store what it returned."""
        step: EnvStep = state.pool.receive()
        for name in ("done", "valid", "reward", "truncated", "score"):
            self.columns[name][:, t, state.envs] = getattr(step, name)
        if self.room is not None:
            self.room[:, t, state.envs] = step.room
        state.frame, state.first = step.frame, ~step.valid

    def collect(
        self, actor: Actor, report: Callable[[int], None] = lambda step: None
    ) -> tuple[Experience, RolloutInfo]:
        """Collect one rollout of every seed.

        Args:
          actor: the policies, leaves [S, ...].
          report: called with the number of steps taken so far.

        Returns:
          The batch for `train_step`, leaves [S, ...], and what the log needs.
        """
        histories = []
        for t in range(self.steps):
            for k, state in enumerate(self.pool_states):
                if t > 0:
                    self.receive_steps(state, t - 1)
                output, window = self.act(k, actor, t)
                self.send_actions(state, t, output, window)
                if t == 0:
                    histories.append(window[:, :-1])
            if t > 0:
                report(t)
        for k, state in enumerate(self.pool_states):
            self.receive_steps(state, self.steps - 1)
            self.act(k, actor, self.steps)  # for its value
        report(self.steps)
        c = self.columns
        rollout = Rollout(
            frames=self.frames.stacked(),
            action=c["action"],
            first=c["first"],
            done=c["done"],
            valid=c["valid"],
        )
        batch = Experience(
            rollout=rollout,
            history=histories[0] if len(histories) == 1 else jnp.concatenate(histories, axis=2),
            reward=c["reward"],
            truncated=c["truncated"],
            log_prob=c["log_prob"],
            value=self.value,
        )
        info = RolloutInfo(
            valid=c["valid"],
            done=c["done"],
            reward=c["reward"],
            score=c["score"],
            room=self.room,
        )
        return batch, info

    def close(self) -> None:
        """Stop the environments."""
        for state in self.pool_states:
            state.pool.close()
