"""E3B: an ellipsoid around the episode's states; what lies outside of it is novel."""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from sndjax.hashing import random_projection
from sndjax.signals.prediction import features_of_all
from sndjax.statistics import no_moments, safe_sqrt, update_moments
from sndjax.types import Rollout, Signal


class Ellipsoid(NamedTuple):
    """The covariance of each environment's episode so far, and its inverse."""

    covariance: Float[Array, "N d d"]
    inverse: Float[Array, "N d d"]


def take_in(
    ellipsoid: Ellipsoid, z: Float[Array, "N d"], counted: Bool[Array, " N"]
) -> tuple[Ellipsoid, Float[Array, " N"]]:
    """C + z z^T and its inverse where `counted` (Sherman and Morrison), and z^T C^-1 z."""
    z = jnp.where(counted[:, None], z, jnp.zeros_like(z))
    across = jnp.einsum("nij,nj->ni", ellipsoid.inverse, z)
    bonus = jax.nn.relu(jnp.einsum("ni,ni->n", z, across))
    outer = across[:, :, None] * across[:, None, :] / (1 + bonus)[:, None, None]
    covariance = ellipsoid.covariance + z[:, :, None] * z[:, None, :]
    return Ellipsoid(covariance, ellipsoid.inverse - outer), bonus


def elliptical_bonus(
    covariance: Float[Array, "N d d"],
    z: Float[Array, "T1 N d"],
    rollout: Rollout,
    ridge: float = 0.1,
) -> tuple[Float[Array, "T N"], Float[Array, "N d d"]]:
    """b(s_t+1) = z^T C^-1 z, with C = ridge I + the sum of z z^T over the episode up to s_t.

    C is inverted once and its inverse then kept along; C itself goes on to the next rollout,
    so that rounding does not pile up over an episode.

    Args:
      covariance: C of each environment's episode so far.
      z: features of s_0 ... s_T.
      rollout: where episodes open, and which rows count.
      ridge: lambda.

    Returns:
      The bonuses and C after the last row.
    """
    chex.assert_rank([covariance, z], 3)
    identity = jnp.eye(z.shape[-1], dtype=z.dtype)[None]

    def step(ellipsoid, row):
        now, then, first, valid = row
        first = first & valid
        fresh = Ellipsoid(ridge * identity, identity / ridge)
        ellipsoid = jax.tree.map(
            lambda new, old: jnp.where(first[:, None, None], new, old), fresh, ellipsoid
        )
        ellipsoid, _ = take_in(ellipsoid, now, first)
        return take_in(ellipsoid, then, valid)

    start = Ellipsoid(covariance, jnp.linalg.inv(covariance))
    rows = (z[:-1], z[1:], rollout.first, rollout.valid)
    ellipsoid, bonus = lax.scan(step, start, rows)
    return bonus, ellipsoid.covariance


def e3b(*, width: int = 128, ridge: float = 0.1) -> Signal:
    """The elliptical bonus of s_t+1 within its episode (Henaff et al., 2022).

    Features are divided by their running root mean square, so that lambda means the same for
    every encoder and float32 is enough; more than `width` of them are projected to `width` at
    random first, so that the state holds N * width^2 numbers. Nothing is trained by the signal;
    the paper's encoder is trained by inverse dynamics.

    Args:
      width: of the features that the ellipsoid is in.
      ridge: lambda, of the covariance an episode starts with.

    >>> e3b()  # doctest: +ELLIPSIS
    Signal(init=...)
    """

    def init(key, example, features, num_actions):
        wide = features.z.shape[-1]
        narrow = min(width, wide)
        fresh = ridge * jnp.eye(narrow)
        return {}, {
            "projection": random_projection(key, wide, narrow) if narrow < wide else None,
            "covariance": jnp.broadcast_to(fresh, (example.shape[0], narrow, narrow)),
            "squares": no_moments(()),
        }

    def reward(params, state, view, rollout, key):
        z = features_of_all(view, rollout.frames)
        if state["projection"] is not None:
            z = z @ state["projection"]
        squares = update_moments(state["squares"], jnp.mean(z[:-1] ** 2, axis=-1), rollout.valid)
        z = z / jnp.where(squares.mean > 0, safe_sqrt(squares.mean), 1)
        bonus, covariance = elliptical_bonus(state["covariance"], z, rollout, ridge)
        return bonus, state | {"covariance": covariance, "squares": squares}

    def loss(params, state, view, features, batch, key):
        return jnp.zeros((), features.z.dtype), {}

    return Signal(init, reward, loss)
