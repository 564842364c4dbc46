"""How long the first update will take, before any was timed."""

import time
from typing import Any

import jax
import jax.numpy as jnp

import sndjax
from sndjax import ppo
from sndjax.rollout import transitions

SHARE_OF_PEAK = 0.4  # of a plain matrix product's rate, for an estimate that is rather long


def product_rate(size: int = 1536) -> float:
    """Floating-point operations per second of a float32 matrix product here and now."""
    product = jax.jit(lambda a: a @ a)
    a = jnp.ones((size, size))
    product(a).block_until_ready()
    begun = time.monotonic()
    product(a).block_until_ready()
    return 2 * size**3 / (time.monotonic() - begun)


def operations(function: Any, *args: Any) -> float:
    """Floating-point operations of a function, as XLA counts them without compiling."""
    cost = jax.jit(function).lower(*args).cost_analysis()
    return float(cost.get("flops", 0.0)) if cost else 0.0


def update_seconds(agent: sndjax.Agent, state: Any, batch: Any, seeds: int) -> float:
    """A rough time for one update of all seeds: its operations at a share of the product's rate."""
    shape = lambda tree: jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), tree)
    state, batch = shape(state), shape(batch)
    rows, size = batch.reward.size, agent.ppo.minibatch_size
    older = batch.history.shape[0]
    frame = batch.rollout.frames.shape[2:]
    stacked = jax.ShapeDtypeStruct(
        (size, *frame[:-1], frame[-1] * (older + 1)), batch.rollout.frames.dtype
    )

    def policy(params, stacked):
        logits, value = agent.network.apply(params, stacked)
        return jnp.sum(ppo.entropy(logits)) + jnp.sum(value)

    total = operations(jax.grad(policy), state.policy, stacked) * agent.ppo.epochs * rows / size
    if agent.motivation is not None:
        module, size = agent.motivation.module, agent.motivation.minibatch_size

        def loss(params, module_state, rollout, key):
            few = transitions(rollout, jnp.arange(size))
            return module.loss(params, module_state, few, rollout, key)[0]

        args = (state.intrinsic, state.intrinsic_state, batch.rollout, state.key)
        total += operations(jax.grad(loss), *args) * rows / size
        total += operations(module.reward, *args)
    return seeds * total / (SHARE_OF_PEAK * product_rate())
