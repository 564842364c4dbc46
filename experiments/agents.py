"""From a configuration to an agent, and from a function of one seed to a function of all."""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

import sndjax
from experiments.devices import ONE_DEVICE, OneDevice
from experiments.environments import Pool
from experiments.extension import load_module
from experiments.options import COPYING, AlgoConfig, Config, ConfigError
from sndjax.acting import scale_vectors
from sndjax.algorithms import NAMED


def motivation_of(algo: AlgoConfig, num_actions: int, size: sndjax.Architecture) -> Any:
    """The motivation of a configuration, or None for the baseline.

    Raises:
      ConfigError: this cell refuses this environment, or the user's module is none.
    """
    own: dict[str, Any] = {"preprocess": algo.preprocess, "activation": algo.activation}
    if algo.signal in COPYING:
        own["pairing"] = algo.pairing
    if algo.signal == "prediction":
        own["gradient"] = algo.gradient
    if algo.name == "ppo":
        return None
    if algo.module is not None:
        make = partial(load_module, algo.module)
        own = {}
    elif algo.name == "grid":
        make = partial(sndjax.grid, algo.objective, algo.signal)
    else:
        make = cast(Any, NAMED[algo.name])
    return sndjax.Motivation(
        make(num_actions, size, **own),
        algo.eta,
        cast(Any, algo.reward_scale),  # one of the choices: it was validated
        algo.learning_rate,
        algo.minibatch_size,
        algo.shuffle,
    )


def build(config: Config, pool: Pool) -> sndjax.Agent:
    """The agent of a configuration for the frames and actions of a pool."""
    if pool.dtype != np.uint8:
        if config.network != "thesis":
            raise ConfigError(
                f"network={config.network} (which preset=laptop says too) is for pixels; "
                f"{config.env.id} has none"
            )
        size = sndjax.VECTOR
    elif config.network == "small":
        size = sndjax.SMALL
    else:
        size = sndjax.ATARI if pool.shape[-1] == 1 else sndjax.PROCGEN
    motivation = motivation_of(config.algo, pool.num_actions, size)
    return sndjax.Agent(
        sndjax.ActorCritic(size, pool.num_actions, 2 if motivation else 1),
        sndjax.Hyperparameters(**asdict(config.ppo)),
        motivation,
        sndjax.Stack(config.env.stack, config.env.repeat_first),
        pool.unbounded,
        config.env.random_action,
    )


def encoder(agent: sndjax.Agent) -> Callable[..., Any] | None:
    """(state, frames[B, *frame], action[B]) -> features[B, d] of one seed, jitted; None without."""
    read = agent.motivation.module.features if agent.motivation else None
    if read is None:
        return None

    @jax.jit
    def encode(state, frames, action):
        seen = scale_vectors(frames, state.observations, agent.unbounded)
        return read(state.intrinsic, state.intrinsic_state, seen, action)

    return encode


def over_seeds(
    function: Callable[..., Any], seeds: int, shared: int = 0, axis: str | None = None
) -> Callable[..., Any]:
    """A function of leaves [S, ...]: mapped over seeds, its last `shared` arguments the same.

    One seed is not mapped but squeezed: a batch axis of one costs time on a CPU. On several
    devices `axis` is the mesh's axis of seeds.
    """
    if seeds > 1:
        in_axes = lambda args: [0] * (len(args) - shared) + [None] * shared
        return lambda *args: jax.vmap(function, in_axes(args), spmd_axis_name=axis)(*args)

    def single(*args):
        own, same = args[: len(args) - shared], args[len(args) - shared :]
        result = function(*jax.tree.map(lambda x: x[0], own), *same)
        return jax.tree.map(lambda x: x[None], result)

    return single


def first_states(agent: sndjax.Agent, seeds: list[int], example: Any) -> sndjax.TrainState:
    """The state of every seed before its first iteration, leaves [S, ...].

    One seed after another: under vmap the orthogonal weights become a batched QR
    decomposition, and two of those at once deadlock jaxlib 0.10.2 on a CPU of two cores (each
    holds a thread of the pool and waits there for the other's).
    """
    init = jax.jit(partial(sndjax.init, agent))
    states = [init(jax.random.key(seed), example) for seed in seeds]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)


def make_train_step(agent: sndjax.Agent, config: Config, layout: OneDevice = ONE_DEVICE) -> Any:
    """`train_step` of every seed, leaves [S, ...], with what a number that goes wrong does."""
    step = sndjax.make_train_step(agent, layout.spread)

    def watched(state, batch):
        state, metrics, reward = step(state, batch)
        fine = sndjax.all_finite(state._replace(key=()))
        return state, metrics | {"state_finite": fine}, reward

    steps = {"stop": watched, "skip": sndjax.skip_nonfinite(step), "ignore": step}
    return over_seeds(steps[config.on_nan], config.num_seeds, axis=layout.axis)
