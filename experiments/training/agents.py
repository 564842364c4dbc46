"""Agents built from a configuration, and functions of one seed mapped over all seeds."""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any, cast

import jax
import jax.numpy as jnp

import sndjax
from sndjax.acting import scale_observations
from sndjax.algorithms import NAMED

from ..config.library import has_predictor
from ..config.schema import Config
from ..environments.pool import Pool
from ..system.jax_settings import at_precision
from .network_sizes import module_activation, network_sizes
from .placement import SINGLE_DEVICE, SingleDevice
from .seeds import map_over_seeds
from .user_module import load_module


def make_intrinsic_config(
    config: Config, num_actions: int, size: sndjax.Architecture
) -> sndjax.IntrinsicConfig | None:
    """Return the intrinsic module of a configuration with its settings; None for the baseline.

    Args:
      config: the configuration, for the algorithm, its constructors' options and the activation.
      num_actions: A, the number of actions of the environment.
      size: the sizes of the networks.

    Raises:
      ConfigError: the user's module cannot be loaded.
      ValueError: the module does not support this environment.
    """
    algo = config.algo
    if algo.name == "ppo":
        return None
    own: dict[str, Any] = {
        "preprocess": algo.preprocess,
        "activation": module_activation(config),
        "weights": (algo.objective_weight, algo.signal_weight),
        "objective_options": config.objective,
        "signal_options": config.signal,
    }
    if has_predictor(algo.signal):
        own["pairing"] = algo.pairing
    if algo.module is not None:
        make = partial(load_module, algo.module)
        own = config.module
    elif algo.name == "grid":
        make = partial(sndjax.make_module, algo.objective, algo.signal)
    else:
        make = cast(Any, NAMED[algo.name])
    return sndjax.IntrinsicConfig(
        module=make(num_actions, size, **own),
        eta=algo.eta,
        reward_scale=cast(Any, algo.reward_scale),  # validated: it is one of the choices
        learning_rate=algo.learning_rate,
        minibatch_size=algo.minibatch_size,
        shuffle=algo.shuffle,
        epochs=algo.epochs,
        anneal_iterations=config.iterations if algo.anneal_learning_rate else 0,
        adam_eps=algo.adam_eps,
        max_grad_norm=algo.max_grad_norm,
    )


def make_hyperparameters(config: Config) -> sndjax.Hyperparameters:
    """Return the settings of PPO, and how rewards are combined."""
    options = asdict(config.ppo)
    anneals = options.pop("anneal_learning_rate")
    return sndjax.Hyperparameters(
        **options,
        combine=cast(Any, config.combine),
        anneal_iterations=config.iterations if anneals else 0,
    )


def build_agent(config: Config, pool: Pool) -> sndjax.AgentSpec:
    """Return the agent of a configuration for the frames and actions of a pool.

    Raises:
      ConfigError: the network does not fit the frames, or the user's module cannot be loaded.
      ValueError: the module does not support this environment.
    """
    intrinsic = make_intrinsic_config(
        config, pool.num_actions, network_sizes(config, pool, "module")
    )
    streams = 2 if intrinsic and config.combine == "streams" else 1
    size = network_sizes(config, pool, "policy")
    return sndjax.AgentSpec(
        network=sndjax.ActorCritic(size, pool.num_actions, streams),
        ppo=make_hyperparameters(config),
        intrinsic=intrinsic,
        stack=sndjax.FrameStack(config.env.stack, config.env.repeat_first),
        unbounded=pool.unbounded,
        random_action=config.env.random_action,
    )


def make_encode(agent: sndjax.AgentSpec) -> Callable[..., Any] | None:
    """Return the encoder of the agent's module as a jitted function of one seed.

    Returns:
      (state, frames[B, *frame], action[B]) -> features float32[B, d]; None if the agent has no
      module or the module has no features.
    """
    features = agent.intrinsic.module.features if agent.intrinsic else None
    if features is None:
        return None

    @jax.jit
    def encode(state: sndjax.TrainState, frames: jax.Array, action: jax.Array) -> jax.Array:
        seen = scale_observations(agent, frames, state.observations)
        return features(state.intrinsic, state.intrinsic_state, seen, action)

    return encode


def make_init_states(agent: sndjax.AgentSpec) -> Callable[[list[int], Any], sndjax.TrainState]:
    """Return a function that makes the state of every seed before its first iteration.

    The seeds are initialized one after another: under vmap the orthogonal initialization becomes
    a batched QR decomposition, and two of these at once deadlock jaxlib 0.10.2 on a CPU with two
    cores (each holds a thread of the pool and waits in it for the thread of the other).

    Args:
      agent: the agent.

    Returns:
      (the seed of each state, frames [N, *frame] for their shape and dtype) -> leaves [S, ...].
    """
    init = jax.jit(partial(sndjax.init_train_state, agent))

    def init_states(seeds: list[int], example: Any) -> sndjax.TrainState:
        states = [init(jax.random.key(seed), example) for seed in seeds]
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)

    return init_states


def make_seed_train_step(
    agent: sndjax.AgentSpec, config: Config, placement: SingleDevice = SINGLE_DEVICE
) -> Callable[..., Any]:
    """Return `train_step` of one seed, with NaN handled according to `on_nan`.

    Args:
      agent: the agent that learns.
      config: the configuration, for `on_nan` and the precision of products.
      placement: the devices that compute.
    """
    step = sndjax.make_train_step(agent, placement.shard_rows, placement.beside)

    def watched(state: sndjax.TrainState, batch: sndjax.Experience) -> Any:
        state, metrics, reward = step(state, batch)
        fine = sndjax.all_finite(cast(Any, state)._replace(key=()))
        return state, metrics | {"state_finite": fine}, reward

    own = {"stop": watched, "skip": sndjax.skip_nonfinite(step), "ignore": step}[config.on_nan]
    return at_precision(config.precision, own)


def make_seeds_train_step(
    agent: sndjax.AgentSpec, config: Config, placement: SingleDevice = SINGLE_DEVICE
) -> Callable[..., Any]:
    """Return `train_step` of every seed, leaves [S, ...], with NaN handled according to `on_nan`.

    Args:
      agent: the agent that learns.
      config: the configuration, for `on_nan` and the number of seeds.
      placement: the devices that compute the rows of a minibatch.
    """
    step = make_seed_train_step(agent, config, placement)
    return map_over_seeds(step, placement.seeds_here(config.num_seeds), axis=placement.axis)
