"""Never Give Up: new to the episode, times new to the agent's life."""

from typing import Literal, NamedTuple

import chex
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from sndjax.hashing import random_projection
from sndjax.networks import Encoder
from sndjax.signals.distillation import distillation, novelty_of_all
from sndjax.signals.prediction import features_of_all
from sndjax.statistics import deviation, no_moments, update_moments
from sndjax.types import Moments, Rollout, Signal


class Memory(NamedTuple):
    """What each environment's episode has seen, and how far apart states usually are."""

    z: Float[Array, "N C d"]  # a ring: the newest C states
    size: Int[Array, " N"]  # states seen since the episode began
    distances: Float[Array, ""]  # how many neighbour distances are averaged so far
    mean: Float[Array, ""]  # d_m^2, the mean of their squares


class Kernel(NamedTuple):
    """The constants of the episodic novelty, as published."""

    neighbours: int = 10
    epsilon: float = 1e-4
    cluster: float = 0.008
    constant: float = 1e-3
    most: float = 8.0  # similarity beyond which nothing is novel


def remember(memory: Memory, z: Float[Array, "N d"], counted: Bool[Array, " N"]) -> Memory:
    """Put a state into each memory that is `counted`, over its oldest where it is full."""
    envs = jnp.arange(z.shape[0])
    slot = memory.size % memory.z.shape[1]
    kept = jnp.where(counted[:, None], z, memory.z[envs, slot])
    return memory._replace(
        z=memory.z.at[envs, slot].set(kept), size=memory.size + counted.astype(memory.size.dtype)
    )


def episodic_novelty(
    memory: Memory, z: Float[Array, "N d"], valid: Bool[Array, " N"], kernel: Kernel
) -> tuple[Float[Array, " N"], Memory]:
    """1 / (sqrt(sum over the k nearest of K(z, z_i)) + c) against what is in memory::

        K(x, y) = epsilon / (max(||x - y||^2 / d_m^2 - xi, 0) + epsilon)

    and 0 where the root plus c is above `most` (Badia et al., 2020, algorithm 1). The valid
    rows' distances enter the running mean d_m^2 before it is used.
    """
    capacity = memory.z.shape[1]
    k = min(kernel.neighbours, capacity)
    squared = jnp.sum((memory.z - z[:, None]) ** 2, axis=-1)
    filled = jnp.arange(capacity)[None] < memory.size[:, None]
    nearest = -lax.top_k(jnp.where(filled, -squared, -jnp.inf), k)[0]
    there = jnp.isfinite(nearest)
    counted = there & valid[:, None]
    count = memory.distances + jnp.sum(counted, dtype=memory.mean.dtype)
    total = jnp.sum(jnp.where(counted, nearest, jnp.zeros_like(nearest)))
    mean = (memory.distances * memory.mean + total) / jnp.maximum(count, 1)
    distance = nearest / jnp.where(mean > 0, mean, 1)
    distance = jnp.maximum(distance - kernel.cluster, 0)
    similar = jnp.where(there, kernel.epsilon / (distance + kernel.epsilon), 0)
    similarity = jnp.sqrt(jnp.sum(similar, axis=-1)) + kernel.constant
    novelty = jnp.where(similarity > kernel.most, 0, 1 / similarity)
    return novelty, memory._replace(distances=count, mean=mean)


def episodic_rewards(
    memory: Memory, z: Float[Array, "T1 N d"], rollout: Rollout, kernel: Kernel
) -> tuple[Float[Array, "T N"], Memory]:
    """The episodic novelty of every s_t+1 among the states of its episode up to s_t."""
    chex.assert_rank([memory.z, z], 3)

    def step(memory, row):
        now, then, first, valid = row
        first = first & valid
        memory = memory._replace(size=jnp.where(first, 0, memory.size))
        memory = remember(memory, now, first)
        novelty, memory = episodic_novelty(memory, then, valid, kernel)
        return remember(memory, then, valid), novelty

    memory, novelty = lax.scan(step, memory, (z[:-1], z[1:], rollout.first, rollout.valid))
    return novelty, memory


def lifelong_factor(
    error: Float[Array, "T N"], moments: Moments, most: float = 5.0
) -> Float[Array, "T N"]:
    """clip(1 + (error - mean) / deviation, 1, L): how much more novel than usual.

    >>> from sndjax.types import Moments
    >>> moments = Moments(jnp.array(4.0), jnp.array(1.0), jnp.array(4.0))
    >>> lifelong_factor(jnp.array([[0.0, 2.0, 9.0]]), moments)
    Array([[1., 2., 5.]], dtype=float32)
    """
    return jnp.clip(1 + (error - moments.mean) / deviation(moments), 1.0, most)


def ngu(
    learned: Encoder,
    *,
    capacity: int = 1024,
    width: int = 32,
    kernel: Kernel = Kernel(),
    most: float = 5.0,
    reading: Literal["mean", "half_sum"] = "mean",
    reduction: Literal["mean", "sum"] = "mean",
    keep: float = 1.0,
) -> Signal:
    """Episodic novelty of s_t+1 times its lifelong one (Badia et al., 2020).

    The lifelong novelty is the distillation error in units of its running deviation. Features
    of more than `width` components are projected to `width` at random; the paper's encoder
    is trained by inverse dynamics, 32 wide.

    Args:
      learned, reading, reduction, keep: of the distillation, see there.
      capacity: C, newest states of an episode that are compared with.
      width: of the features in memory; N * C * width numbers.
      kernel: the constants of the episodic novelty.
      most: L, which the lifelong factor is clipped to.
    """
    base = distillation(learned, reading=reading, reduction=reduction, keep=keep)

    def init(key, example, features, num_actions):
        key_base, key_projection = jax.random.split(key)
        params, _ = base.init(key_base, example, features, num_actions)
        envs, wide = example.shape[0], features.z.shape[-1]
        narrow = min(width, wide)
        zero = jnp.zeros(())
        memory = Memory(jnp.zeros((envs, capacity, narrow)), jnp.zeros(envs, jnp.int32), zero, zero)
        return params, {
            "projection": random_projection(key_projection, wide, narrow)
            if narrow < wide
            else None,
            "memory": memory,
            "errors": no_moments(()),
        }

    def reward(params, state, view, rollout, key):
        z = features_of_all(view, rollout.frames)
        error = novelty_of_all(learned, params, view, rollout.frames, z, reading)[1:]
        if state["projection"] is not None:
            z = z @ state["projection"]
        episodic, memory = episodic_rewards(state["memory"], z, rollout, kernel)
        errors = update_moments(state["errors"], error, rollout.valid)
        factor = lifelong_factor(error, errors, most)
        return episodic * factor, state | {"memory": memory, "errors": errors}

    return Signal(init, reward, base.loss)
