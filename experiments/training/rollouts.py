"""The collection of rollouts: the policy acts, the pools step, every frame is stored once.

With two pools, the environments of one pool step while the policy acts in the other.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sndjax import Actor, ActOutput, Experience, Rollout

from ..config.schema import Config
from ..environments.pool import EnvStep, Pool


class RolloutInfo(NamedTuple):
    """The data of a rollout that the log needs; arrays are [S, T, N]."""

    valid: np.ndarray
    game_over: np.ndarray
    reward: np.ndarray
    score: np.ndarray
    room: np.ndarray | None


def experience_spec(config: Config, pool: Pool, value_heads: int) -> Experience:
    """Return the shapes and dtypes of the batches that a run collects.

    Args:
      config: the configuration, for its seeds, environments, rollout length and stack.
      pool: any pool of its environments, for the shape and dtype of frames.
      value_heads: K, the number of value heads of the policy.
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
    """Return the number of pools that the environments are divided into.

    There are two if the policy runs on another device than the CPU on which the environments step.
    If both run on the CPU, each would only wait for the other.
    """
    return 2 if jax.default_backend() != "cpu" and num_envs % 2 == 0 else 1


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


@dataclass
class PoolState:
    """A pool, with the newest frames and the stacks of its environments."""

    pool: Pool
    envs: slice  # the positions of its environments among all
    frame: Any  # [S, n, *frame], the newest
    first: np.ndarray  # [S, n], whether the frame is the first of an episode
    window: Any  # [S, stack, n, *frame], the stack before this frame


class Collector:
    """The collector of rollouts from the pools of all seeds.

    The next rollout reuses the buffers: learning from a batch must end before the next batch is
    collected.
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
          stack: the number of frames in a stack.
          steps: T, the number of steps of a rollout.
          heads: K, the number of value heads.
          place: a function that copies frames [S, n, ...] to the devices that learn.
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
            "game_over": np.zeros(rows, bool),
            "valid": np.zeros(rows, bool),
            "reward": np.zeros(rows, np.float32),
            "truncated": np.zeros(rows, bool),
            "log_prob": np.zeros(rows, np.float32),
            "score": np.zeros(rows, np.float32),
        }
        self.value: Any = np.zeros((seeds, steps + 1, envs, heads), np.float32)
        self.room: Any = np.zeros(rows, np.uint8) if pool.rooms else None

    def act(self, k: int, actor: Actor, t: int) -> tuple[ActOutput, Any]:
        """Compute the actions of one step in one pool, and store the values.

        Args:
          k: the index of the pool.
          actor: the policies, leaves [S, ...].
          t: the step.

        Returns:
          The output of the policies, and the stacks with the newest frame.
        """
        state = self.pool_states[k]
        state.frame = self.frames.put(t, state.envs, state.frame)
        step = np.int32(t * len(self.pool_states) + k)
        output, window = self.policy_act(actor, state.window, state.frame, state.first, step)
        self.value[:, t, state.envs] = output.value
        return output, window

    def send_actions(self, state: PoolState, t: int, output: ActOutput, window: Any) -> None:
        """Start step t of a pool's environments, and store the output of the policies.

        Args:
          state: the state of the pool.
          t: the step.
          output: the output of the policies.
          window: the stacks that the policies got.
        """
        state.pool.send(np.asarray(output.executed))
        state.window = window
        columns = self.columns
        columns["action"][:, t, state.envs] = output.action
        columns["log_prob"][:, t, state.envs] = output.log_prob
        columns["first"][:, t, state.envs] = state.first

    def receive_steps(self, state: PoolState, t: int) -> None:
        """Wait for step t of a pool's environments, and store its results."""
        step: EnvStep = state.pool.receive()
        for name in ("done", "game_over", "valid", "reward", "truncated", "score"):
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
          The batch for `train_step`, leaves [S, ...], and the data for the log.
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
            self.act(k, actor, self.steps)  # only for the value of the last frame
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
        columns = {name: c[name] for name in ("valid", "game_over", "reward", "score")}
        return batch, RolloutInfo(**columns, room=self.room)

    def close(self) -> None:
        """Stop the environments."""
        for state in self.pool_states:
            state.pool.close()
