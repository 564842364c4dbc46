"""The collection of rollouts: the policy acts, the pools step, every frame is stored once.

With two pools, the environments of one pool step while the policy acts in the other.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sndjax import Actor, ActorCritic, ActorMemory, ActOutput, Experience, Rollout

from ..config.schema import Config
from ..environments.pool import EnvStep, Pool
from .frame_buffers import DeviceFrames, HostFrames


class RolloutInfo(NamedTuple):
    """The data of a rollout that the log needs; arrays are [S, T, N]."""

    valid: np.ndarray
    game_over: np.ndarray
    reward: np.ndarray
    score: np.ndarray
    room: np.ndarray | None


def experience_spec(config: Config, pool: Pool, network: ActorCritic) -> Experience:
    """Return the shapes and dtypes of the batches that a run collects.

    Args:
      config: the configuration, for its seeds, environments, rollout length and stack.
      pool: any pool of its environments, for the shape and dtype of frames.
      network: the policy, for its value heads and its memory.
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
        value=array(np.float32, steps + 1, envs, network.value_heads),
        hidden=init_hidden(network, seeds, envs),
    )


def init_hidden(network: ActorCritic, seeds: int, envs: int) -> Any:
    """Return the recurrent state of every seed before an episode, [S, N, d]; None without any.

    Args:
      network: the policy.
      seeds: S.
      envs: N.
    """
    one = network.initial_memory(envs)
    return None if one is None else np.zeros((seeds, *one.shape), one.dtype)


def choose_num_pools(num_envs: int) -> int:
    """Return the number of pools that the environments are divided into.

    There are two if the policy runs on another device than the CPU on which the environments step.
    If both run on the CPU, each would only wait for the other.
    """
    return 2 if jax.default_backend() != "cpu" and num_envs % 2 == 0 else 1


@dataclass
class PoolState:
    """A pool, with the newest frames and what the policy remembers of its environments."""

    pool: Pool
    envs: slice  # the positions of its environments among all
    frame: Any  # [S, n, *frame], the newest
    first: np.ndarray  # [S, n], whether the frame is the first of an episode
    memory: ActorMemory  # leaves [S, ...], before this frame


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
        network: ActorCritic,
        place: Callable[[np.ndarray], Any] = jax.device_put,
    ):
        """Reset the pools.

        Args:
          pools: the environments of all seeds, in groups of the same size.
          act: `sndjax.act` of the agent, mapped over seeds.
          stack: the number of frames in a stack.
          steps: T, the number of steps of a rollout.
          network: the policy, for its value heads and its memory.
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
                memory=ActorMemory(
                    np.zeros((seeds, stack, size, *pool.shape), pool.dtype),  # type: ignore
                    init_hidden(network, seeds, size),
                ),
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
        self.value: Any = np.zeros((seeds, steps + 1, envs, network.value_heads), np.float32)
        self.room: Any = np.zeros(rows, np.uint8) if pool.rooms else None

    def act(self, k: int, actor: Actor, t: int) -> tuple[ActOutput, ActorMemory]:
        """Compute the actions of one step in one pool, and store the values.

        Args:
          k: the index of the pool.
          actor: the policies, leaves [S, ...].
          t: the step.

        Returns:
          The output of the policies, and their memory with the newest frame.
        """
        state = self.pool_states[k]
        state.frame = self.frames.put(t, state.envs, state.frame)
        step = np.int32(t * len(self.pool_states) + k)
        output, memory = self.policy_act(actor, state.memory, state.frame, state.first, step)
        self.value[:, t, state.envs] = output.value
        return output, memory

    def send_actions(
        self, state: PoolState, t: int, output: ActOutput, memory: ActorMemory
    ) -> None:
        """Start step t of a pool's environments, and store the output of the policies.

        Args:
          state: the state of the pool.
          t: the step.
          output: the output of the policies.
          memory: of the policies after it.
        """
        state.pool.send(np.asarray(output.executed))
        state.memory = memory
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
        histories: list[Any] = []
        hidden: list[Any] = [state.memory.hidden for state in self.pool_states]
        for t in range(self.steps):
            for k, state in enumerate(self.pool_states):
                if t > 0:
                    self.receive_steps(state, t - 1)
                output, memory = self.act(k, actor, t)
                self.send_actions(state, t, output, memory)
                if t == 0:
                    histories.append(memory.window[:, :-1])
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
            hidden=hidden[0] if len(hidden) == 1 else self.join_hidden(hidden),
        )
        columns = {name: c[name] for name in ("valid", "game_over", "reward", "score")}
        return batch, RolloutInfo(**columns, room=self.room)

    def join_hidden(self, hidden: list[Any]) -> Any:
        """Join the recurrent states of all pools, [S, n, d] each; None without a memory."""
        return None if hidden[0] is None else jnp.concatenate(hidden, axis=1)

    def close(self) -> None:
        """Stop the environments."""
        for state in self.pool_states:
            state.pool.close()
