"""E3B: an ellipsoid around the episode's states; what lies outside of it is novel."""

import math
from typing import Any, NamedTuple

import chex
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray, Shaped

from sndjax.hashing import random_projection
from sndjax.products import EXACT
from sndjax.protocols import EncoderView, Signal
from sndjax.ranges import Count, Positive
from sndjax.signals.prediction import encode_rollout
from sndjax.statistics import (
    init_running_statistics,
    mask_rows,
    safe_sqrt,
    std,
    update_running_statistics,
)
from sndjax.types import Features, Loss, Params, Rollout, RunningStatistics, State, Transition


class E3BState(NamedTuple):
    """What E3B keeps between rollouts."""

    root: Float[Array, "N d d"]  # of the inverse covariance of each environment's episode so far
    projection: Float[Array, "w d"] | None  # None where features are narrow enough
    squares: RunningStatistics | None  # of the mean square of features; None: they are not scaled
    bonuses: RunningStatistics | None  # None: bonuses are not normalised


def add_to_ellipsoid(
    root: Float[Array, "N d d"], z: Float[Array, "N d"], counted: Bool[Array, " N"]
) -> tuple[Float[Array, "N d d"], Float[Array, " N"]]:
    """Add z z^T to the covariance C where `counted`, given a root S of its inverse, S S^T = C^-1::

        phi = S^T z,  b = phi^T phi = z^T C^-1 z,  S' = S - a / (1 + sqrt(a)) S phi phi^T
        a = 1 / (1 + b)

    This is Potter's form of the Kalman filter's update (Potter, 1963). S S^T cannot lose its sign,
    and S has half the digits of C^-1 to keep: over thousands of states that are alike, the formula
    of Sherman and Morrison for C^-1 itself loses the bonus to rounding.

    Args:
      root: S of each environment.
      z: features of one state of each.
      counted: the environments whose state is added.

    Returns:
      The new root, and z^T C^-1 z in the old one.
    """
    z = mask_rows(z, counted)
    phi = jnp.einsum("nji,nj->ni", root, z, precision=EXACT)
    bonus = jnp.sum(phi**2, axis=-1)
    share = 1 / (1 + bonus)
    back = jnp.einsum("nij,nj->ni", root, phi, precision=EXACT)
    across = back * (share / (1 + jnp.sqrt(share)))[:, None]
    return root - across[:, :, None] * phi[:, None, :], bonus


def elliptical_bonus(
    root: Float[Array, "N d d"], z: Float[Array, "T1 N d"], rollout: Rollout, ridge: float = 0.1
) -> tuple[Float[Array, "T N"], Float[Array, "N d d"]]:
    """Compute b(s_t+1) = z^T C^-1 z, C = ridge I + the sum of z z^T over the episode up to s_t.

    Args:
      root: S of each environment's episode so far, S S^T = C^-1, see `add_to_ellipsoid`. Before
        any state it is I / sqrt(ridge).
      z: features of s_0 ... s_T.
      rollout: where episodes open, and which rows count.
      ridge: lambda.

    Returns:
      The bonuses and S after the last row.
    """
    chex.assert_rank([root, z], 3)
    fresh = jnp.eye(z.shape[-1], dtype=z.dtype)[None] / math.sqrt(ridge)

    def step(
        root: Float[Array, "N d d"], row: tuple[Array, Array, Array, Array]
    ) -> tuple[Float[Array, "N d d"], Float[Array, " N"]]:
        now, after, first, valid = row
        first = first & valid
        root = jnp.where(first[:, None, None], fresh, root)
        root, _ = add_to_ellipsoid(root, now, first)
        return add_to_ellipsoid(root, after, valid)

    root, bonus = lax.scan(step, root, (z[:-1], z[1:], rollout.first, rollout.valid))
    return bonus, root


def e3b(
    *,
    width: Count = 128,
    ridge: Positive = 0.1,
    scale_features: bool = False,
    normalize: bool = True,
) -> Signal:
    """Make the elliptical bonus of s_t+1 within its episode (Henaff et al., 2022).

    Features of more than `width` components are projected to `width` at random first, so that the
    state holds N * width^2 numbers. Nothing is trained by the signal; the paper's encoder is
    trained by inverse dynamics. The defaults of the other options are those of the authors' code.

    Args:
      width: of the features that the ellipsoid is in.
      ridge: lambda, of the covariance an episode starts with.
      scale_features: divide features by their running root mean square, so that lambda means the
        same for every encoder.
      normalize: divide bonuses by their running standard deviation, this rollout included.

    >>> e3b()
    e3b(width=128, ridge=0.1, scale_features=False, normalize=True)
    """

    def init(
        key: PRNGKeyArray,
        example: Shaped[Array, "N *frame"],
        features: Features,
        num_actions: int,
    ) -> tuple[Params, E3BState]:
        wide = features.z.shape[-1]
        narrow = min(width, wide)
        fresh = jnp.eye(narrow, dtype=jnp.float32) / math.sqrt(ridge)
        return {}, E3BState(
            root=jnp.broadcast_to(fresh, (example.shape[0], narrow, narrow)),
            projection=random_projection(key, wide, narrow) if narrow < wide else None,
            squares=init_running_statistics(()) if scale_features else None,
            bonuses=init_running_statistics(()) if normalize else None,
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
        squares, bonuses = state.squares, state.bonuses
        if squares is not None:
            mean_square = jnp.mean(z[:-1] ** 2, axis=-1)
            squares = update_running_statistics(squares, mean_square, rollout.valid)
            z = z / jnp.where(squares.mean > 0, safe_sqrt(squares.mean), 1)
        bonus, root = elliptical_bonus(state.root, z, rollout, ridge)
        if bonuses is not None:
            bonuses = update_running_statistics(bonuses, bonus, rollout.valid)
            bonus = bonus / std(bonuses)
        return bonus, state._replace(root=root, squares=squares, bonuses=bonuses)

    def loss(
        params: Params,
        state: State,
        view: EncoderView,
        features: Features,
        batch: Transition,
        key: PRNGKeyArray,
    ) -> Loss:
        return jnp.zeros((), features.z.dtype), {}

    settings: dict[str, Any] = {"width": width, "ridge": ridge}
    settings |= {"scale_features": scale_features, "normalize": normalize}
    made = Signal(init, reward, loss, name="e3b", settings=settings)
    return made._replace(has_published_scale=False, episodic=True)
