"""E3B: an ellipsoid around the episode's states; what lies outside of it is novel."""

import chex
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from sndjax.hashing import random_projection
from sndjax.signals.prediction import features_of_all
from sndjax.types import Rollout, Signal


def take_in(
    inverse: Float[Array, "N d d"], z: Float[Array, "N d"], counted: Bool[Array, " N"]
) -> tuple[Float[Array, "N d d"], Float[Array, " N"]]:
    """(C + z z^T)^-1 from C^-1 where `counted` (Sherman and Morrison), and z^T C^-1 z."""
    across = jnp.einsum("nij,nj->ni", inverse, z)
    bonus = jnp.einsum("ni,ni->n", z, across)
    outer = across[:, :, None] * across[:, None, :] / (1 + bonus)[:, None, None]
    return jnp.where(counted[:, None, None], inverse - outer, inverse), bonus


def elliptical_bonus(
    inverse: Float[Array, "N d d"],
    z: Float[Array, "T1 N d"],
    rollout: Rollout,
    ridge: float = 0.1,
) -> tuple[Float[Array, "T N"], Float[Array, "N d d"]]:
    """b(s_t+1) = z^T C^-1 z, with C = ridge I + the sum of z z^T over the episode up to s_t.

    Args:
      inverse: C^-1 of each environment's episode so far.
      z: features of s_0 ... s_T.
      rollout: where episodes open, and which rows count.
      ridge: lambda.

    Returns:
      The bonuses and C^-1 after the last row.
    """
    chex.assert_rank([inverse, z], 3)
    fresh = jnp.eye(z.shape[-1], dtype=z.dtype)[None] / ridge

    def step(inverse, row):
        now, then, first, valid = row
        first = first & valid
        inverse = jnp.where(first[:, None, None], fresh, inverse)
        inverse, _ = take_in(inverse, now, first)
        return take_in(inverse, then, valid)

    inverse, bonus = lax.scan(step, inverse, (z[:-1], z[1:], rollout.first, rollout.valid))
    return bonus, inverse


def e3b(*, width: int = 128, ridge: float = 0.1) -> Signal:
    """The elliptical bonus of s_t+1 within its episode (Henaff et al., 2022).

    Features of more than `width` components are projected to `width` at random, so that the
    state holds N * width^2 numbers. Nothing is trained by the signal; the paper's encoder is
    trained by inverse dynamics.

    Args:
      width: of the features that the ellipsoid is in.
      ridge: lambda, of the covariance an episode starts with.
    """

    def init(key, example, features, num_actions):
        wide = features.z.shape[-1]
        narrow = min(width, wide)
        fresh = jnp.eye(narrow) / ridge
        return {}, {
            "projection": random_projection(key, wide, narrow) if narrow < wide else None,
            "inverse": jnp.broadcast_to(fresh, (example.shape[0], narrow, narrow)),
        }

    def reward(params, state, view, rollout, key):
        z = features_of_all(view, rollout.frames)
        if state["projection"] is not None:
            z = z @ state["projection"]
        bonus, inverse = elliptical_bonus(state["inverse"], z, rollout, ridge)
        return bonus, state | {"inverse": inverse}

    def loss(params, state, view, features, batch, key):
        return jnp.zeros((), features.z.dtype), {}

    return Signal(init, reward, loss)
