"""Rollouts as one compiled program: of environments in JAX, and of envpool's vectors on a CPU.

Where a step takes microseconds, what a step of `Collector` costs is its calls and copies. A program
with a pool of envpool holds its address: every run compiles it again, which takes a second.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap

import sndjax
from sndjax.collecting import collect_steps, make_row

from ..config.schema import Config
from ..environments.pool import Pool, training_reward
from ..environments.pools import EnvpoolPool
from ..system.jax_settings import at_precision
from .recorder import init_hidden
from .rollouts import RolloutInfo
from .seeds import map_over_seeds

ENVIRONMENT_STREAM = 2  # folded into a seed's key; acting folds 1, learning 0
# (actor, environments) of one seed -> (batch, environments, the task's own reward)
CollectOneSeed = Callable[[sndjax.Actor, sndjax.LiveEnvironments], Any]


def make_pool_step(pool: EnvpoolPool) -> Callable[[Any], tuple[Any, ...]]:
    """Return a jittable function of one seed that steps the environments of all seeds.

    Returns:
      action[N] -> (frame[N, ...], reward[N], terminated[N], truncated[N]); under `jax.vmap` over
      the seeds it is one step of the pool.
    """
    handle, _, _, xla_step = pool.envs.xla()

    def step_all(action: Any) -> tuple[Any, ...]:
        _, (observation, *columns, _) = xla_step(handle, action.astype(jnp.int32))
        return pool.reader.read(observation), *columns

    @custom_vmap
    def step(action: Any) -> tuple[Any, ...]:
        # With several seeds this line only gives the shapes: the next function runs.
        return jax.tree.map(lambda x: x[: action.shape[0]], step_all(action))

    @step.def_vmap
    def step_seeds(axis_size: int, in_batched: Any, action: Any) -> tuple[Any, Any]:
        """Step the environments of all seeds, and return the results and their axes.

        Args:
          axis_size: S.
          in_batched: whether the argument has the axis of the seeds, which it has.
          action: [S, N].
        """
        columns = step_all(action.reshape(-1))
        split = lambda x: x.reshape(axis_size, -1, *x.shape[1:])
        return tuple(map(split, columns)), (True,) * len(columns)

    return step


def make_envpool_collect(
    pool: EnvpoolPool, agent: sndjax.AgentSpec, config: Config
) -> CollectOneSeed:
    """Return a function of one seed that collects a rollout of a pool, not jitted.

    Args:
      pool: the environments of all seeds.
      agent: what acts.
      config: of the run.
    """
    pool_step = make_pool_step(pool)

    def step(live: sndjax.LiveEnvironments, action: Any, t: Any) -> Any:
        frame, *columns = pool_step(action)
        row = make_row(live, *columns)
        return row, live._replace(frame=frame, first=live.ended, ended=row.done)

    def collect(actor: sndjax.Actor, live: sndjax.LiveEnvironments) -> Any:
        batch, live = collect_steps(agent, actor, live, step, config.rollout_length)
        return with_training_reward(config, batch, live)

    return at_precision(config.precision, collect)


def make_jax_collect(
    env: sndjax.JaxEnvironment, agent: sndjax.AgentSpec, config: Config
) -> CollectOneSeed:
    """Return a function of one seed that collects a rollout of environments in JAX, not jitted.

    Args:
      env: with its observations read as frames.
      agent: what acts.
      config: of the run.
    """

    def collect(actor: sndjax.Actor, live: sndjax.LiveEnvironments) -> Any:
        key = jax.random.fold_in(actor.key, ENVIRONMENT_STREAM)
        batch, live = sndjax.collect(agent, env, actor, live, key, config.rollout_length)
        return with_training_reward(config, batch, live)

    return at_precision(config.precision, collect)


def with_training_reward(
    config: Config, batch: sndjax.Experience, live: sndjax.LiveEnvironments
) -> tuple[sndjax.Experience, sndjax.LiveEnvironments, Any]:
    """Return a batch with the reward that is learned from, the environments, and the task's reward.

    Args:
      config: of the run.
      batch: with the task's own reward.
      live: the environments after it.
    """
    terminated = batch.rollout.done & ~batch.truncated
    reward = training_reward(config.env, batch.reward, terminated).astype(jnp.float32)
    return batch._replace(reward=reward), live, batch.reward


def first_environments(
    pool: EnvpoolPool, stack: int, network: sndjax.ActorCritic
) -> sndjax.LiveEnvironments:
    """Reset a pool, and return its environments, leaves [S, ...].

    Args:
      pool: the environments of all seeds.
      stack: the number of frames that the policy sees.
      network: the policy, for its memory.
    """
    frame = jnp.array(pool.reset())
    seeds, envs = pool.rows
    return sndjax.LiveEnvironments(
        state=(),
        frame=frame,
        first=jnp.ones((seeds, envs), bool),
        ended=jnp.zeros((seeds, envs), bool),
        window=jnp.zeros((seeds, stack, envs, *pool.shape), pool.dtype),
        hidden=jax.tree.map(jnp.asarray, init_hidden(network, seeds, envs)),
    )


class ScanCollector:
    """A collector whose rollouts are one program, with the results of `Collector`."""

    def __init__(self, pool: Pool, collect: CollectOneSeed, live: sndjax.LiveEnvironments):
        """Take the parts; nothing is compiled yet.

        Args:
          pool: the environments of all seeds.
          collect: collects a rollout of one seed.
          live: the environments, leaves [S, ...].
        """
        self.pool, self.live = pool, live
        self.program = jax.jit(map_over_seeds(collect, pool.rows[0]), donate_argnums=1)

    def collect(
        self,
        actor: sndjax.Actor,
        report: Callable[[int], None] = lambda step: None,
        beside: Callable[[float], None] = lambda share: None,
    ) -> tuple[sndjax.Experience, RolloutInfo]:
        """Collect one rollout of every seed, in one program: `beside` is never called.

        Args:
          actor: the policies, leaves [S, ...].
          report: called with the number of steps at the end.
          beside: see `Collector.collect`.
        """
        batch, self.live, score = self.program(actor, self.live)
        columns = (batch.rollout.valid, batch.rollout.done, batch.reward, score)
        valid, done, reward, score = map(np.asarray, columns)
        report(valid.shape[1])
        info = RolloutInfo(valid=valid, game_over=done, reward=reward, score=score, room=None)
        return batch, info

    def close(self) -> None:
        """Stop the environments."""
        self.pool.close()
