"""Barlow Twins on consecutive states (eq. 3.11)."""

import chex
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sndjax.products import matmul
from sndjax.protocols import Encode, Objective
from sndjax.ranges import Weight
from sndjax.statistics import mask_rows, masked_mean, masked_sum, valid_count
from sndjax.types import Features, Loss, Params, Rollout, Transition


def barlow_twins_loss(
    z: Float[Array, "B d"],
    z_next: Float[Array, "B d"],
    valid: Bool[Array, " B"],
    redundancy_weight: float = 5e-3,
) -> Loss:
    """Compute Barlow Twins over the n valid rows, on features normalised along the batch::

        L = sum_i (1 - C_ii)^2 + lambda sum_i sum_{j != i} C_ij^2                 (3.11)
        C = 1/n sum_b z^_b z^'_b^T,  z^ = (z - mean) / sqrt(variance + 1e-5), the one with 1/n

    The 1e-5 is batch normalisation's. (Zbontar et al., 2021, whose lambda this is;
    consecutive states stand for their two views.)

    Args:
      z: features of s_t.
      z_next: features of s_t+1.
      valid: the rows that count.
      redundancy_weight: lambda.

    Returns:
      The scalar loss and its two terms, unweighted.

    >>> z = jnp.array([[1.0, 1], [1, -1], [-1, 1], [-1, -1]])
    >>> barlow_twins_loss(z, z, jnp.ones(4, bool))[0].round(6)
    Array(0., dtype=float32)
    """
    chex.assert_equal_shape([z, z_next])
    count = valid_count(valid, z.dtype)

    def normalise(z: Float[Array, "B d"]) -> Float[Array, "B d"]:
        centred = mask_rows(z - masked_mean(z, valid)[None], valid)
        return centred / jnp.sqrt(masked_sum(centred**2, valid) / count + 1e-5)[None]

    correlation = matmul(normalise(z).T, normalise(z_next)) / count
    own = jnp.eye(z.shape[1], dtype=bool)
    invariance = jnp.sum((1 - jnp.diagonal(correlation)) ** 2)
    others = jnp.sum(jnp.where(own, jnp.zeros_like(correlation), correlation) ** 2)
    return invariance + redundancy_weight * others, {
        "barlow_invariance": invariance,
        "barlow_redundancy": others,
    }


def barlow_twins(redundancy_weight: Weight = 5e-3) -> Objective:
    """Make the Barlow Twins objective (eq. 3.11), without parameters. See `barlow_twins_loss`.

    Args:
      redundancy_weight: lambda, the weight of the correlations between different features.

    >>> barlow_twins()
    barlow_twins(redundancy_weight=0.005)
    """

    def init(key: PRNGKeyArray, features: Features, num_actions: int) -> Params:
        return {}

    def loss(
        params: Params,
        encode: Encode,
        features: Features,
        batch: Transition,
        rollout: Rollout,
        key: PRNGKeyArray,
    ) -> Loss:
        return barlow_twins_loss(features.z, features.z_next, batch.valid, redundancy_weight)

    settings = {"redundancy_weight": redundancy_weight}
    return Objective(init, loss, name="barlow_twins", settings=settings)
