"""The collection of rollouts: policies act, pools step, every frame goes to the device once.

With two pools, the environments of one pool step while policies act in the other.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from sndjax import Actor, ActorCritic, ActorMemory, AgentSpec, Experience, Rollout

from ..config.schema import Config
from ..environments.pool import EnvStep, Pool
from .cpu_cores import usable_cores
from .placement import SingleDevice
from .recorder import Opening, Record, first_memory, init_hidden, make_recorder


def env_threads() -> int | None:
    """Return the number of threads that step each pool; None: envpool's choice, one for each core.

    Beside an accelerator it is one less than there are cores. Both pools may use all of these: they
    step at the same time only now and then, and a pool whose policy is awaited leaves its cores to
    the other. The core that is left starts the programs of the device, for which all of them wait.
    """
    return None if jax.default_backend() == "cpu" else max(1, usable_cores() - 1)


# What the environments return in every step.
COLUMNS: dict[str, Any] = {
    "first": bool,
    "done": bool,
    "game_over": bool,
    "valid": bool,
    "reward": np.float32,
    "truncated": bool,
    "score": np.float32,
}


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


def choose_num_pools(num_envs: int) -> int:
    """Return the number of pools that the environments are divided into.

    There are two if the policy runs on another device than the CPU on which the environments step.
    If both run on the CPU, each would only wait for the other.
    """
    return 2 if jax.default_backend() != "cpu" and num_envs % 2 == 0 else 1


@dataclass
class PoolState:
    """A pool, with its newest frames and the rollout that is recorded of it."""

    pool: Pool
    envs: slice  # the positions of its environments among all
    frame: np.ndarray  # [S, n, *frame], the newest
    first: np.ndarray  # [S, n], whether the frame is the first of an episode
    memory: ActorMemory  # of the policies before this frame, between two rollouts
    record: Record | None = None  # of the running rollout


class Collector:
    """The collector of rollouts from the pools of all seeds.

    A step sends frames to the devices that act, and gets the actions back; everything else that the
    policies compute stays there until the rollout is whole. A rollout has buffers of its own:
    the next may be collected while this one is learned from.
    """

    def __init__(self, pools: list[Pool], agent: AgentSpec, config: Config, acting: SingleDevice):
        """Reset the pools.

        Args:
          pools: the environments of all seeds, in groups of the same size.
          agent: what acts.
          config: of the run, for its seeds and the length of its rollouts.
          acting: the placement of the policies.
        """
        seeds, size = pools[0].rows
        self.steps = config.rollout_length
        self.rows = (seeds, self.steps, size * len(pools))
        self.acting = acting
        self.recorder = acting.compile_recorder(make_recorder(agent, config, acting.axis))
        self.pool_states = []
        for k, pool in enumerate(pools):
            frame = pool.reset()
            state = PoolState(
                pool=pool,
                envs=slice(k * size, (k + 1) * size),
                frame=frame,
                first=np.ones((seeds, size), bool),
                memory=acting.put_memory(first_memory(agent, frame)),
            )
            self.pool_states.append(state)

    def act(self, k: int, actor: Actor, t: int) -> Any:
        """Start to compute the actions of one step in one pool, and return them.

        Args:
          k: the index of the pool.
          actor: the policies, leaves [S, ...].
          t: the step.
        """
        state = self.pool_states[k]
        draw = np.int32(t * len(self.pool_states) + k)
        executed, state.record = self.recorder.act(
            actor, state.record, state.frame, state.first, np.int32(t), draw
        )
        return executed

    def send_actions(self, state: PoolState, executed: Any) -> None:
        """Wait for the actions of a pool, and start its step."""
        state.pool.send(self.acting.local_rows(executed))

    def receive_steps(self, state: PoolState, t: int) -> None:
        """Wait for step t of a pool's environments, and store its results."""
        step: EnvStep = state.pool.receive()
        for name, column in self.columns.items():
            column[:, t, state.envs] = state.first if name == "first" else getattr(step, name)
        state.frame, state.first = step.frame, ~step.valid

    def open_rollout(self) -> list[Opening]:
        """Start a rollout of every pool, with new buffers."""
        self.columns = {name: np.zeros(self.rows, dtype) for name, dtype in COLUMNS.items()}
        if self.pool_states[0].pool.rooms:
            self.columns["room"] = np.zeros(self.rows, np.uint8)
        openings = []
        for state in self.pool_states:
            state.record, opening = self.recorder.open(state.memory, state.frame, state.first)
            openings.append(opening)
        return openings

    def collect(
        self,
        actor: Actor,
        report: Callable[[int], None] = lambda step: None,
        beside: Callable[[float], None] = lambda share: None,
    ) -> tuple[Experience, RolloutInfo]:
        """Collect one rollout of every seed.

        Args:
          actor: the policies, leaves [S, ...].
          report: called with the number of steps taken so far.
          beside: called whenever environments have begun to step, with the share of the rollout
            that is done: what it starts on the device runs while they do.

        Returns:
          The batch for `train_step`, leaves [S, ...], and the data for the log.
        """
        openings, pools = self.open_rollout(), len(self.pool_states)
        for t in range(self.steps):
            for k, state in enumerate(self.pool_states):
                if t > 0:
                    self.receive_steps(state, t - 1)
                self.send_actions(state, self.act(k, actor, t))
                beside((t * pools + k + 1) / (self.steps * pools))
            if t > 0:
                report(t)
        for k, state in enumerate(self.pool_states):
            self.receive_steps(state, self.steps - 1)
            self.act(k, actor, self.steps)  # only for the value of the last frame
        report(self.steps)
        return self.close_rollout(openings)

    def take_records(self) -> list[Record]:
        """Return the record of every pool, of which only the memory stays here."""
        records = []
        for state in self.pool_states:
            assert state.record is not None
            records.append(state.record)
            state.memory, state.record = state.record.memory, None
        return records

    def close_rollout(self, openings: list[Opening]) -> tuple[Experience, RolloutInfo]:
        """Return the whole rollout, and the data for the log.

        Args:
          openings: what it began with.
        """
        recorded, columns = self.recorder.join(self.take_records(), openings), self.columns
        rollout: dict[str, Any] = {name: columns[name] for name in ("first", "done", "valid")}
        own: dict[str, Any] = {name: columns[name] for name in ("reward", "truncated")}
        batch = Experience(
            rollout=Rollout(frames=recorded.frames, action=recorded.action, **rollout),
            history=recorded.history,
            log_prob=recorded.log_prob,
            value=recorded.value,
            hidden=recorded.hidden,
            **own,
        )
        shown = {name: columns[name] for name in ("valid", "game_over", "reward", "score")}
        return batch, RolloutInfo(**shown, room=columns.get("room"))

    def close(self) -> None:
        """Stop the environments."""
        for state in self.pool_states:
            state.pool.close()
