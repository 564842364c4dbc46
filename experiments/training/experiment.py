"""`build_experiment(config)`: the environments of a configuration and the agent for them."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sndjax

from ..config.jax_suites import JAX_SUITES
from ..config.schema import Config
from ..environments.pool import Pool
from ..environments.pools import EnvpoolPool, make_pools
from ..system.errors import ConfigError
from ..system.process import available_memory
from .agents import build_agent, make_init_states, make_seeds_train_step
from .cpu_cores import place_on_cores
from .placement import SINGLE_DEVICE, SingleDevice
from .policy_lag import first_actor
from .rollouts import Collector, choose_num_pools, env_threads
from .scan_collector import (
    ScanCollector,
    first_environments,
    make_envpool_collect,
    make_jax_collect,
)
from .seeds import map_over_seeds

START_STREAM = 3  # folded into a seed's key for the environments' first resets


class RunState(NamedTuple):
    """Everything that a run changes, leaves [S, ...].

    Attributes:
      train: what learning changes.
      environments: `sndjax.LiveEnvironments`; () where they step outside jax.
      next_actor: `NextActor`, what collects the next rollout; () where the newest policy does.
    """

    train: sndjax.TrainState
    environments: Any
    next_actor: Any


class Experiment(NamedTuple):
    """The objects that a configuration describes; functions are compiled on their first use.

    Attributes:
      config: the configuration.
      pools: its environments, in groups that step independently.
      agent: the agent that learns.
      placement: the devices that compute.
      example: zeros of the shape and dtype of frames [N, *frame].
    """

    config: Config
    pools: list[Pool]
    agent: sndjax.AgentSpec
    placement: SingleDevice
    example: jax.Array

    @property
    def pool(self) -> Pool:
        """Return the first pool. All pools have the same shapes, dtypes and actions."""
        return self.pools[0]

    def init_states(self) -> sndjax.TrainState:
        """Return the state of every seed before its first iteration, leaves [S, ...]."""
        return make_init_states(self.agent)(self.config.seeds, self.example)

    def init_run(self) -> RunState:
        """Return everything that the run changes, before its first iteration."""
        train = self.init_states()
        first = jax.jit(map_over_seeds(first_actor, self.config.num_seeds))
        start = RunState(
            train=train,
            environments=self.init_environments(train),
            next_actor=first(train) if self.config.overlap else (),
        )
        return RunState(*map(self.placement.put_states, start))

    def init_environments(self, states: sndjax.TrainState) -> Any:
        """Return the environments of every seed at their start; () if they step outside jax.

        Args:
          states: before the first iteration, leaves [S, ...].
        """
        env, config = self.pool.environment, self.config
        if env is None:
            return ()
        start = lambda key: sndjax.init_environments(
            env,
            jax.random.fold_in(key, START_STREAM),
            config.num_envs,
            config.env.stack,
            self.agent.network,
        )
        return jax.jit(map_over_seeds(start, config.num_seeds))(states.key)

    def run_shapes(self) -> RunState:
        """Return the shapes and dtypes of `init_run`; nothing is computed."""
        train = jax.eval_shape(self.init_states)
        first = map_over_seeds(first_actor, self.config.num_seeds)
        return RunState(
            train=train,
            environments=jax.eval_shape(self.init_environments, train),
            next_actor=jax.eval_shape(first, train) if self.config.overlap else (),
        )

    def make_collector(self) -> Collector | ScanCollector:
        """Reset the environments, and return the collector of their rollouts."""
        pool, agent, config = self.pool, self.agent, self.config
        acting = self.placement.acting
        here = jax.default_backend() == "cpu" and acting.axis is None
        if pool.environment is not None:
            live = self.init_environments(self.init_states())
            return ScanCollector(pool, make_jax_collect(pool.environment, agent, config), live)
        if here and isinstance(pool, EnvpoolPool) and pool.dtype != np.uint8:
            live = acting.put(first_environments(pool, config.env.stack, agent.network))
            return ScanCollector(pool, make_envpool_collect(pool, agent, config), live)
        return Collector(self.pools, agent, config, self.placement.acting)

    def make_train_step(self) -> Callable[..., Any]:
        """Return `train_step` of every seed, leaves [S, ...], not jitted."""
        return make_seeds_train_step(self.agent, self.config, self.placement)


def check_rollout_memory(config: Config, pool: Pool) -> None:
    """Check that the observations of a rollout fit the memory of this machine.

    Raises:
      ConfigError: they do not.
    """
    frame = math.prod(pool.shape) * np.dtype(pool.dtype).itemsize
    needed = config.num_seeds * (config.rollout_length + 1) * config.num_envs * frame
    if config.overlap:
        needed *= 2  # one is learned from while the other is collected
    available = available_memory()
    if needed > available:
        raise ConfigError(
            f"the observations of a rollout, num_envs={config.num_envs} x rollout_length="
            f"{config.rollout_length} of shape {pool.shape}, take {needed / 1e9:,.0f} GB, and "
            f"{available / 1e9:,.0f} GB are free; take fewer of either"
        )


def build_experiment(
    config: Config,
    placement: SingleDevice = SINGLE_DEVICE,
    start_iteration: int = 0,
    probe: bool = False,
    groups: int | None = None,
) -> Experiment:
    """Return the environments and the agent of a configuration.

    Args:
      config: a valid configuration.
      placement: the devices that compute, and the environments that this host steps.
      start_iteration: the iteration that the run starts at; it seeds the environments' streams.
      groups: the number of pools that the environments are divided into; None: as fits the device.
      probe: make only one environment, to read its spaces, and close it. For agents that play in
        other environments, or in none.

    Raises:
      ConfigError: the task cannot be made or trained on, or the algorithm does not support it.
    """
    if probe:
        pools = make_pools(config.env, config.seeds[:1], 1)
        pools[0].close()
    else:
        pools = make_pools(
            config.env,
            config.seeds,
            config.num_envs,
            start_iteration,
            1
            if config.env.suite in JAX_SUITES
            else placement.num_pools(groups or choose_num_pools(config.num_envs), config.num_envs),
            placement.local_env_slice(config.num_envs),
            env_threads(),
        )
        check_rollout_memory(config, pools[0])
    if type(placement) is SingleDevice:
        placement = place_on_cores(config, pools[0], placement)
    agent = build_agent(config, pools[0])
    example = jnp.zeros((config.num_envs, *pools[0].shape), pools[0].dtype)
    try:
        jax.eval_shape(partial(sndjax.init_train_state, agent), jax.random.key(0), example)
    except ValueError as error:  # the objective does not support this environment
        raise ConfigError(f"algo={config.algo.name}: {error}") from None
    return Experiment(config, pools, agent, placement, example)
