"""Hash counts: a state is novel where few states so far had its hash code."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sndjax.hashing import random_projection, simhash_code
from sndjax.signals.prediction import features_of_all
from sndjax.types import Signal


def take_in_counts(
    counts: Float[Array, " K"], code: Int[Array, " M"], valid: Bool[Array, " M"]
) -> Float[Array, " K"]:
    """The counts with each valid code counted once more.

    >>> take_in_counts(jnp.zeros(3), jnp.array([2, 2, 0]), jnp.array([True, True, False]))
    Array([0., 0., 2.], dtype=float32)
    """
    return counts.at[code].add(valid.astype(counts.dtype))


def simhash(bits: int = 16) -> Signal:
    """1 / sqrt(n(Phi(s_t))), Phi the signs of `bits` random projections (eq. 4.18).

    Tang et al. (2017). The rollout's own states are counted before its rewards are read. The
    counts of a trained encoder are of codes that drift with it. Nothing is trained by the signal.

    >>> simhash()  # doctest: +ELLIPSIS
    Signal(init=...)
    """

    def init(key, example, features, num_actions):
        projection = random_projection(key, features.z.shape[-1], bits)
        return {}, {"projection": projection, "counts": jnp.zeros(2**bits)}

    def reward(params, state, view, rollout, key):
        z = features_of_all(view, rollout.frames[:-1])
        code = simhash_code(z, state["projection"])
        counts = take_in_counts(state["counts"], code.reshape(-1), rollout.valid.reshape(-1))
        novelty = 1 / jnp.sqrt(jnp.maximum(counts[code], 1))
        return novelty, state | {"counts": counts}

    def loss(params, state, view, features, batch, key):
        return jnp.zeros((), features.z.dtype), {}

    return Signal(init, reward, loss)
