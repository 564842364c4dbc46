"""Hash counts: a state is novel where few states so far had its hash code."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from sndjax.hashing import random_projection, simhash_code
from sndjax.protocols import EncoderView, Signal
from sndjax.ranges import HashBits
from sndjax.signals.prediction import encode_rollout
from sndjax.statistics import init_running_statistics, update_running_statistics
from sndjax.types import (
    Features,
    Loss,
    Params,
    Rollout,
    RunningStatistics,
    State,
    Transition,
)


class SimHashState(NamedTuple):
    """What the hash counts keep between rollouts."""

    counts: Float[Array, " K"]  # of each code, K = 2^k
    projection: Float[Array, "d k"]
    features: RunningStatistics | None  # None where features are hashed as they are


def add_counts(
    counts: Float[Array, " K"], code: Int[Array, " M"], valid: Bool[Array, " M"]
) -> Float[Array, " K"]:
    """Return the counts with each valid code counted once more.

    Args:
      counts: of each code so far.
      code: of M states.
      valid: the states that count.

    >>> add_counts(jnp.zeros(3), jnp.array([2, 2, 0]), jnp.array([True, True, False]))
    Array([0., 0., 2.], dtype=float32)
    """
    return counts.at[code].add(valid.astype(counts.dtype))


def simhash(num_hash_bits: HashBits = 16, *, centre: bool = True) -> Signal:
    """Make 1 / sqrt(n(Phi(s_t))), Phi the signs of `num_hash_bits` random projections (eq. 4.18).

    Tang et al. (2017). The rollout's own states are counted before its rewards are read. The
    counts of a trained encoder are of codes that drift with it. Nothing is trained by the signal.

    Args:
      num_hash_bits: k, of the hash.
      centre: subtract the running mean of features before they are hashed. Features of pixels share
        a large mean, and with it most states have the same signs.

    >>> simhash()
    simhash(num_hash_bits=16, centre=True)
    """

    def init(
        key: PRNGKeyArray,
        example: Shaped[Array, "N *frame"],
        features: Features,
        num_actions: int,
    ) -> tuple[Params, SimHashState]:
        width = features.z.shape[-1]
        return {}, SimHashState(
            counts=jnp.zeros(2**num_hash_bits, jnp.float32),
            projection=random_projection(key, width, num_hash_bits),
            features=init_running_statistics((width,)) if centre else None,
        )

    def reward(
        params: Params,
        state: SimHashState,
        view: EncoderView,
        rollout: Rollout,
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, "T N"], SimHashState]:
        z = encode_rollout(view, rollout.frames[:-1])
        seen = state.features
        if seen is not None:
            seen = update_running_statistics(seen, z, rollout.valid)
            z = z - seen.mean[None, None]
        code = simhash_code(z, state.projection)
        counts = add_counts(state.counts, code.reshape(-1), rollout.valid.reshape(-1))
        novelty = 1 / jnp.sqrt(jnp.maximum(counts[code], 1))
        return novelty, state._replace(counts=counts, features=seen)

    def loss(
        params: Params,
        state: State,
        view: EncoderView,
        features: Features,
        batch: Transition,
        key: PRNGKeyArray,
    ) -> Loss:
        return jnp.zeros((), features.z.dtype), {}

    settings = {"num_hash_bits": num_hash_bits, "centre": centre}
    return Signal(init, reward, loss, name="simhash", settings=settings)
