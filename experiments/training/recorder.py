"""A rollout under way, on the devices that act: per step one program, and the actions come back."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import sndjax
from sndjax.rollout import push_frame

from ..config.schema import Config
from ..system.jax_settings import at_precision
from .seeds import map_over_seeds


class Record(NamedTuple):
    """What a rollout of one pool has so far; T + 1 rows, of which the last only has a value.

    Attributes:
      memory: what the policies remember before the newest frame, leaves [S, ...].
      frames: [S, T + 1, n, *frame].
      action: int32 [S, T + 1, n].
      log_prob: float32 [S, T + 1, n].
      value: float32 [S, T + 1, n, K].
    """

    memory: sndjax.ActorMemory
    frames: Any
    action: Any
    log_prob: Any
    value: Any


class Opening(NamedTuple):
    """What a rollout begins with: the older frames of its first stack, the recurrent state."""

    history: Any  # [S, stack - 1, n, *frame]
    hidden: Any  # [S, n, d], or None


class Recorded(NamedTuple):
    """The part of an `Experience` that is made on the devices that act; named as there."""

    frames: Any
    action: Any
    log_prob: Any
    value: Any
    history: Any
    hidden: Any


class Recorder(NamedTuple):
    """The programs that record a rollout.

    Attributes:
      open: (memory, frame, first) -> (record, opening). The memory is donated.
      act: (actor, record, frame, first, t, draw) -> (executed actions, record). The record is
        donated. `t` is the row, and `draw` seeds the random draws.
      join: (records, openings) of all pools -> `Recorded`.
    """

    open: Callable[..., tuple[Record, Opening]]
    act: Callable[..., tuple[Any, Record]]
    join: Callable[[list[Record], list[Opening]], Recorded]


def make_recorder(agent: sndjax.AgentSpec, config: Config, axis: str | None = None) -> Recorder:
    """Return the programs that record the rollouts of all seeds, not jitted.

    Args:
      agent: what acts.
      config: of the run, for its seeds and the length of its rollouts.
      axis: on several devices, the name of the mesh's axis of seeds.
    """
    seeds, steps = config.num_seeds, config.rollout_length
    act_one = at_precision(config.precision, partial(sndjax.act, agent))
    act_seeds = map_over_seeds(act_one, seeds, 1, axis)
    push = partial(push_frame, repeat=agent.stack.repeat)
    push_seeds = map_over_seeds(push, seeds, axis=axis)

    def open_record(memory: sndjax.ActorMemory, frame: Any, first: Any) -> tuple[Record, Opening]:
        rows = (frame.shape[0], steps + 1, frame.shape[1])
        record = Record(
            memory=memory,
            frames=jnp.zeros((*rows, *frame.shape[2:]), frame.dtype),
            action=jnp.zeros(rows, jnp.int32),
            log_prob=jnp.zeros(rows, jnp.float32),
            value=jnp.zeros((*rows, agent.network.value_heads), jnp.float32),
        )
        stack = push_seeds(memory.window, frame, first)
        # A copy: the memory itself is donated to the first act.
        return record, Opening(stack[:, :-1], jax.tree.map(jnp.copy, memory.hidden))

    def act(
        actor: sndjax.Actor, record: Record, frame: Any, first: Any, t: Any, draw: Any
    ) -> tuple[Any, Record]:
        output, after = act_seeds(actor, record.memory, frame, first, draw)
        put = lambda kept, new: lax.dynamic_update_slice_in_dim(kept, new[:, None], t, axis=1)
        # The frame after the last step is acted on in the next rollout.
        memory = jax.tree.map(lambda new, old: jnp.where(t < steps, new, old), after, record.memory)
        return output.executed, Record(
            memory=memory,
            frames=put(record.frames, frame),
            action=put(record.action, output.action),
            log_prob=put(record.log_prob, output.log_prob),
            value=put(record.value, output.value.astype(jnp.float32)),
        )

    def join(records: list[Record], openings: list[Opening]) -> Recorded:
        cat = lambda parts, axis: parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis)
        columns = {
            name: cat([getattr(record, name) for record in records], 2)
            for name in ("frames", "action", "log_prob", "value")
        }
        hidden = None
        if openings[0].hidden is not None:
            hidden = cat([opening.hidden for opening in openings], 1)
        return Recorded(
            frames=columns["frames"],
            action=columns["action"][:, :steps],
            log_prob=columns["log_prob"][:, :steps],
            value=columns["value"],
            history=cat([opening.history for opening in openings], 2),
            hidden=hidden,
        )

    return Recorder(open_record, act, join)


def first_memory(agent: sndjax.AgentSpec, frame: Any) -> Any:
    """Return what the policies of all seeds remember before any frame, in host memory.

    Args:
      agent: what acts.
      frame: the first frames, [S, n, *frame], for their shape and dtype.
    """
    window = np.zeros((frame.shape[0], agent.stack.size, *frame.shape[1:]), frame.dtype)
    return sndjax.ActorMemory(window, init_hidden(agent.network, *frame.shape[:2]))  # type: ignore[arg-type]


def init_hidden(network: sndjax.ActorCritic, seeds: int, envs: int) -> Any:
    """Return the recurrent state of every seed before an episode, [S, N, d]; None without any.

    Args:
      network: the policy.
      seeds: S.
      envs: N.
    """
    one = network.initial_memory(envs)
    return None if one is None else np.zeros((seeds, *one.shape), one.dtype)
