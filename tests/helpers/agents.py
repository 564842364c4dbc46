"""Make agents at toy size with their train steps, and batches for them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import sndjax
from helpers.rollouts import experience
from sndjax import ppo
from sndjax.algorithms import NAMED

STACKS = {
    "atari": sndjax.FrameStack(4, True),
    "procgen": sndjax.FrameStack(2, False),
    "vector": sndjax.FrameStack(),
}
STEPS, ENVS = 8, 4


@functools.cache
def made(name, kind, **changes):
    """Return an agent at toy size, its first state and its jitted train step."""
    make = NAMED[name]
    intrinsic = None
    if make is not None:
        module = make(kind.actions, kind.size)
        intrinsic = sndjax.IntrinsicConfig(module, eta=1.0, learning_rate=1e-3, minibatch_size=16)
    hyper = ppo.Hyperparameters(minibatch_size=8, epochs=2, learning_rate=1e-3, **changes)
    network = sndjax.ActorCritic(kind.size, kind.actions, 2 if intrinsic else 1)
    agent = sndjax.AgentSpec(network, hyper, intrinsic, STACKS[kind.name])
    state = jax.jit(functools.partial(sndjax.init_train_state, agent))(
        jax.random.key(0), example(kind)
    )
    return agent, state, jax.jit(sndjax.make_train_step(agent))


def example(kind):
    dtype = jnp.uint8 if len(kind.shape) == 3 else jnp.float32
    return jnp.zeros((ENVS, *kind.shape), dtype)


def batch_for(kind, seed=0, heads=2):
    rng = np.random.default_rng(seed)
    return experience(kind, rng, STEPS, ENVS, STACKS[kind.name].size, heads)


def heads(name):
    return 1 if NAMED[name] is None else 2


def equal(one, other, **tolerance):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_allclose(a, b, **tolerance)
