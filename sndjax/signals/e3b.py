"""E3B: an ellipsoid around the episode's states; what lies outside of it is novel."""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray, Shaped

from sndjax.hashing import random_projection
from sndjax.protocols import EncoderView, Signal
from sndjax.signals.prediction import encode_rollout
from sndjax.statistics import init_running_statistics, safe_sqrt, update_running_statistics
from sndjax.types import Features, Loss, Params, Rollout, RunningStatistics, State, Transition


class Ellipsoid(NamedTuple):
    """The covariance of each environment's episode so far, and its inverse."""

    covariance: Float[Array, "N d d"]
    inverse: Float[Array, "N d d"]


class E3BState(NamedTuple):
    """What E3B keeps between rollouts."""

    covariance: Float[Array, "N d d"]  # of each environment's episode so far
    projection: Float[Array, "w d"] | None  # None where features are narrow enough
    squares: RunningStatistics  # of the mean square of features


def update_ellipsoid(
    ellipsoid: Ellipsoid, z: Float[Array, "N d"], counted: Bool[Array, " N"]
) -> tuple[Ellipsoid, Float[Array, " N"]]:
    """Add z z^T to the covariance where `counted` (inverse by Sherman and Morrison).

    Args:
      ellipsoid: of each environment.
      z: features of one state of each.
      counted: the environments whose state is added.

    Returns:
      The new ellipsoid, and z^T C^-1 z in the old one.
    """
    z = jnp.where(counted[:, None], z, jnp.zeros_like(z))
    across = jnp.einsum("nij,nj->ni", ellipsoid.inverse, z)
    bonus = jax.nn.relu(jnp.einsum("ni,ni->n", z, across))
    outer = across[:, :, None] * across[:, None, :] / (1 + bonus)[:, None, None]
    covariance = ellipsoid.covariance + z[:, :, None] * z[:, None, :]
    return Ellipsoid(covariance=covariance, inverse=ellipsoid.inverse - outer), bonus


def elliptical_bonus(
    covariance: Float[Array, "N d d"],
    z: Float[Array, "T1 N d"],
    rollout: Rollout,
    ridge: float = 0.1,
) -> tuple[Float[Array, "T N"], Float[Array, "N d d"]]:
    """Compute b(s_t+1) = z^T C^-1 z, C = ridge I + the sum of z z^T over the episode up to s_t.

    C is inverted once and its inverse then updated; C itself is kept for the next rollout, so
    that rounding does not pile up over an episode.

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

    def step(
        ellipsoid: Ellipsoid, row: tuple[Array, Array, Array, Array]
    ) -> tuple[Ellipsoid, Float[Array, " N"]]:
        now, after, first, valid = row
        first = first & valid
        fresh = Ellipsoid(covariance=ridge * identity, inverse=identity / ridge)
        ellipsoid = jax.tree.map(
            lambda new, old: jnp.where(first[:, None, None], new, old), fresh, ellipsoid
        )
        ellipsoid, _ = update_ellipsoid(ellipsoid, now, first)
        return update_ellipsoid(ellipsoid, after, valid)

    start = Ellipsoid(covariance=covariance, inverse=jnp.linalg.inv(covariance))
    rows = (z[:-1], z[1:], rollout.first, rollout.valid)
    ellipsoid, bonus = lax.scan(step, start, rows)
    return bonus, ellipsoid.covariance


def e3b(*, width: int = 128, ridge: float = 0.1) -> Signal:
    """Make the elliptical bonus of s_t+1 within its episode (Henaff et al., 2022).

    Features are divided by their running root mean square, so that lambda means the same for
    every encoder and float32 is enough; more than `width` of them are projected to `width` at
    random first, so that the state holds N * width^2 numbers. Nothing is trained by the signal;
    the paper's encoder is trained by inverse dynamics.

    Args:
      width: of the features that the ellipsoid is in.
      ridge: lambda, of the covariance an episode starts with.

    >>> e3b()
    e3b(width=128, ridge=0.1)
    """

    def init(
        key: PRNGKeyArray,
        example: Shaped[Array, "N *frame"],
        features: Features,
        num_actions: int,
    ) -> tuple[Params, E3BState]:
        wide = features.z.shape[-1]
        narrow = min(width, wide)
        fresh = ridge * jnp.eye(narrow)
        return {}, E3BState(
            covariance=jnp.broadcast_to(fresh, (example.shape[0], narrow, narrow)),
            projection=random_projection(key, wide, narrow) if narrow < wide else None,
            squares=init_running_statistics(()),
        )

    def reward(
        params: Params,
        state: E3BState,
        view: EncoderView,
        rollout: Rollout,
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, "T N"], E3BState]:
        z = encode_rollout(view, rollout.frames)
        if state.projection is not None:
            z = z @ state.projection
        mean_square = jnp.mean(z[:-1] ** 2, axis=-1)
        squares = update_running_statistics(state.squares, mean_square, rollout.valid)
        z = z / jnp.where(squares.mean > 0, safe_sqrt(squares.mean), 1)
        bonus, covariance = elliptical_bonus(state.covariance, z, rollout, ridge)
        return bonus, state._replace(covariance=covariance, squares=squares)

    def loss(
        params: Params,
        state: State,
        view: EncoderView,
        features: Features,
        batch: Transition,
        key: PRNGKeyArray,
    ) -> Loss:
        return jnp.zeros((), features.z.dtype), {}

    settings = {"width": width, "ridge": ridge}
    return Signal(init, reward, loss, has_published_scale=False, name="e3b", settings=settings)
