"""Never Give Up: new to the episode, times new to the agent's life."""

from typing import Annotated, NamedTuple

import chex
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from sndjax.hashing import random_projection
from sndjax.networks import Encoder
from sndjax.protocols import EncoderView, Signal
from sndjax.ranges import Count, Decay, Positive, Range, Share, Weight
from sndjax.signals.distillation import (
    LossReduction,
    RewardReduction,
    distillation,
    rollout_distillation_error,
)
from sndjax.signals.prediction import encode_rollout
from sndjax.statistics import init_running_statistics, std, update_running_statistics
from sndjax.types import Features, Params, Rollout, RunningStatistics


class Memory(NamedTuple):
    """What each environment's episode has seen, and how far apart states usually are.

    The mean is `total / weight`. With a decay both forget, so that the mean follows an encoder that
    is in training.
    """

    z: Float[Array, "N C d"]  # a ring: the newest C states
    size: Int[Array, " N"]  # states seen since the episode began
    weight: Float[Array, ""]  # of the neighbour distances averaged so far
    total: Float[Array, ""]  # the weighted sum of their squares; d_m^2 is total / weight


class Kernel(NamedTuple):
    """The constants of the episodic novelty, see the arguments of `ngu`."""

    neighbours: int
    epsilon: float
    cluster: float
    constant: float
    max_similarity: float
    distance_decay: float
    full_memory: bool


class NGUState(NamedTuple):
    """What Never Give Up keeps between rollouts."""

    errors: RunningStatistics  # of the distillation error
    memory: Memory
    projection: Float[Array, "w d"] | None  # None where features are narrow enough


def init_memory(envs: int, memory_size: int, width: int) -> Memory:
    """Return an empty memory for every environment.

    Args:
      envs: N.
      memory_size: C.
      width: d.
    """
    return Memory(
        z=jnp.zeros((envs, memory_size, width), jnp.float32),
        size=jnp.zeros(envs, jnp.int32),
        weight=jnp.zeros((), jnp.float32),
        total=jnp.zeros((), jnp.float32),
    )


def append_to_memory(memory: Memory, z: Float[Array, "N d"], counted: Bool[Array, " N"]) -> Memory:
    """Put a state into each memory that is `counted`, over its oldest where it is full.

    Args:
      memory: of each environment.
      z: features of one state of each.
      counted: the environments whose state is put.
    """
    envs = jnp.arange(z.shape[0])
    slot = memory.size % memory.z.shape[1]
    kept = jnp.where(counted[:, None], z, memory.z[envs, slot])
    return memory._replace(
        z=memory.z.at[envs, slot].set(kept), size=memory.size + counted.astype(memory.size.dtype)
    )


def episodic_novelty(
    memory: Memory, z: Float[Array, "N d"], valid: Bool[Array, " N"], kernel: Kernel
) -> tuple[Float[Array, " N"], Memory]:
    """Compute 1 / (sqrt(sum over the k nearest of K(z, z_i)) + c) against what is in memory::

        K(x, y) = epsilon / (max(||x - y||^2 / d_m^2 - xi, 0) + epsilon)

    and 0 where the root plus c is above `max_similarity`, or where fewer than k neighbours are in
    memory (Badia et al., 2020, algorithm 1). The valid rows' distances enter the moving average
    d_m^2 before it is used.

    Args:
      memory: of each environment.
      z: features of one state of each.
      valid: the environments that count.
      kernel: the constants.

    Returns:
      The novelty, and the memory with the new d_m^2.
    """
    capacity = memory.z.shape[1]
    k = min(kernel.neighbours, capacity)
    squared = jnp.sum((memory.z - z[:, None]) ** 2, axis=-1)
    filled = jnp.arange(capacity)[None] < memory.size[:, None]
    nearest = -lax.top_k(jnp.where(filled, -squared, -jnp.inf), k)[0]
    there = jnp.isfinite(nearest)
    counted = there & valid[:, None]
    some, decay = jnp.any(counted), kernel.distance_decay
    decayed = lambda x, more: jnp.where(some, decay * x + more, x)
    weight = decayed(memory.weight, jnp.sum(counted, dtype=memory.weight.dtype))
    total = decayed(memory.total, jnp.sum(jnp.where(counted, nearest, jnp.zeros_like(nearest))))
    mean = total / jnp.where(weight > 0, weight, 1)
    distance = nearest / jnp.where(mean > 0, mean, 1)
    distance = jnp.maximum(distance - kernel.cluster, 0)
    similar = jnp.where(there, kernel.epsilon / (distance + kernel.epsilon), 0)
    similarity = jnp.sqrt(jnp.sum(similar, axis=-1)) + kernel.constant
    novelty = jnp.where(similarity > kernel.max_similarity, 0, 1 / similarity)
    if kernel.full_memory:
        novelty = jnp.where(jnp.all(there, axis=-1), novelty, 0)
    return novelty, memory._replace(weight=weight, total=total)


def episodic_rewards(
    memory: Memory, z: Float[Array, "T1 N d"], rollout: Rollout, kernel: Kernel
) -> tuple[Float[Array, "T N"], Memory]:
    """Compute the episodic novelty of every s_t+1 among the states of its episode up to s_t.

    Args:
      memory: of each environment.
      z: features of s_0 ... s_T.
      rollout: where episodes open, and which rows count.
      kernel: the constants.

    Returns:
      The novelty, and the memory after the last row.
    """
    chex.assert_rank([memory.z, z], 3)

    def step(
        memory: Memory, row: tuple[Array, Array, Array, Array]
    ) -> tuple[Memory, Float[Array, " N"]]:
        now, after, first, valid = row
        first = first & valid
        memory = memory._replace(size=jnp.where(first, 0, memory.size))
        memory = append_to_memory(memory, now, first)
        novelty, memory = episodic_novelty(memory, after, valid, kernel)
        return append_to_memory(memory, after, valid), novelty

    memory, novelty = lax.scan(step, memory, (z[:-1], z[1:], rollout.first, rollout.valid))
    return novelty, memory


def lifelong_factor(
    error: Float[Array, "T N"], moments: RunningStatistics, max_lifelong_factor: float = 5.0
) -> Float[Array, "T N"]:
    """Compute clip(1 + (error - mean) / std, 1, L): how much more novel than usual.

    Args:
      error: the distillation error.
      moments: its running statistics.
      max_lifelong_factor: L.

    >>> moments = RunningStatistics(jnp.array(4.0), jnp.array(1.0), jnp.array(4.0))
    >>> lifelong_factor(jnp.array([[0.0, 2.0, 9.0]]), moments)
    Array([[1., 2., 5.]], dtype=float32)
    """
    return jnp.clip(1 + (error - moments.mean) / std(moments), 1.0, max_lifelong_factor)


def make_ngu(
    predictor: Encoder,
    base: Signal,
    kernel: Kernel,
    memory_size: int,
    width: int,
    max_lifelong_factor: float,
) -> Signal:
    """Make Never Give Up of a distillation and the constants of its episodic novelty. See `ngu`.

    Args:
      predictor: of the distillation.
      base: the distillation.
      kernel: the constants.
      memory_size: C.
      width: of the features in memory.
      max_lifelong_factor: L.
    """

    def init(
        key: PRNGKeyArray,
        example: Shaped[Array, "N *frame"],
        features: Features,
        num_actions: int,
    ) -> tuple[Params, NGUState]:
        key_base, key_projection = jax.random.split(key)
        params, _ = base.init(key_base, example, features, num_actions)
        envs, wide = example.shape[0], features.z.shape[-1]
        narrow = min(width, wide)
        return params, NGUState(
            errors=init_running_statistics(()),
            memory=init_memory(envs, memory_size, narrow),
            projection=random_projection(key_projection, wide, narrow) if narrow < wide else None,
        )

    def reward(
        params: Params,
        state: NGUState,
        view: EncoderView,
        rollout: Rollout,
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, "T N"], NGUState]:
        z = encode_rollout(view, rollout.frames)
        error = rollout_distillation_error(
            predictor, params, view, rollout.frames, z, base.settings["reward_reduction"]
        )[1:]
        z = z if state.projection is None else z @ state.projection
        episodic, memory = episodic_rewards(state.memory, z, rollout, kernel)
        errors = update_running_statistics(state.errors, error, rollout.valid)
        factor = lifelong_factor(error, errors, max_lifelong_factor)
        return episodic * factor, state._replace(memory=memory, errors=errors)

    settings = {
        "memory_size": memory_size,
        "width": width,
        **kernel._asdict(),
        "max_lifelong_factor": max_lifelong_factor,
        **base.settings,
    }
    made = Signal(init, reward, base.loss, name="ngu", settings=settings)
    return made._replace(has_published_scale=False, episodic=True)


def ngu(
    predictor: Encoder,
    *,
    memory_size: Count = 1024,
    width: Count = 32,
    neighbours: Count = 10,
    epsilon: Positive = 1e-4,
    cluster: Weight = 0.008,
    constant: Weight = 1e-3,
    max_similarity: Positive = 8.0,
    distance_decay: Decay = 0.99,
    full_memory: bool = True,
    max_lifelong_factor: Annotated[float, Range(low=1)] = 5.0,
    reward_reduction: RewardReduction = "mean",
    loss_reduction: LossReduction = "mean",
    update_proportion: Share = 1.0,
) -> Signal:
    """Make the episodic novelty of s_t+1 times its lifelong novelty (Badia et al., 2020).

    The lifelong novelty is the distillation error in units of its running standard deviation.
    Features of more than `width` components are projected to `width` at random; the paper's
    encoder is trained by inverse dynamics, 32 wide.

    Args:
      predictor: of the distillation, see `distillation`.
      memory_size: C, newest states of an episode that are compared with.
      width: of the features in memory; N * C * width numbers.
      neighbours: k, the nearest states in memory that count.
      epsilon: of the kernel epsilon / (d^2 / d_m^2 + epsilon).
      cluster: xi, the distance below which a neighbour counts as the same state.
      constant: c, added to the root of the sum over the kernel.
      max_similarity: the similarity beyond which nothing is novel.
      distance_decay: of d_m^2 at each step; 1: the mean over all steps.
      full_memory: nothing is novel before k neighbours are in memory.
      max_lifelong_factor: L, which the lifelong factor is clipped to.
      reward_reduction: of the distillation.
      loss_reduction: of the distillation.
      update_proportion: of the distillation.
    """
    kernel = Kernel(
        neighbours=neighbours,
        epsilon=epsilon,
        cluster=cluster,
        constant=constant,
        max_similarity=max_similarity,
        distance_decay=distance_decay,
        full_memory=full_memory,
    )
    base = distillation(
        predictor,
        reward_reduction=reward_reduction,
        loss_reduction=loss_reduction,
        update_proportion=update_proportion,
    )
    return make_ngu(predictor, base, kernel, memory_size, width, max_lifelong_factor)
