"""Variance-invariance-covariance regularisation of consecutive states (eq. 3.12-3.15, 5.7)."""

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sndjax.products import matmul
from sndjax.protocols import Encode, Objective
from sndjax.ranges import Weight
from sndjax.statistics import mask_rows, masked_mean, masked_sum, valid_count
from sndjax.types import Features, Loss, Params, Rollout, Transition


def vicreg_loss(
    z: Float[Array, "B d"],
    z_next: Float[Array, "B d"],
    valid: Bool[Array, " B"],
    invariance_weight: float = 1.0,
    variance_weight: float = 1.0,
    covariance_weight: float = 1 / 25,
) -> Loss:
    """Compute VICReg on the features of s_t and s_t+1, over the n valid rows::

        L   = lambda s(Z, Z') + mu [v(Z) + v(Z')] + nu [c(Z) + c(Z')]            (5.7)
        s   = 1/(n d) sum_i ||z_i - z'_i||^2                                     (3.14)
        v   = 1/d sum_j max(0, 1 - sqrt(var_j + 1e-4))                           (3.12)
        c   = 1/d sum_{i != j} C_ij^2,  C the covariance with 1/(n - 1)          (3.13)

    The variance is unbiased too. (Bardes et al., 2022.)

    Args:
      z: features of s_t.
      z_next: features of s_t+1.
      valid: the rows that count.
      invariance_weight: lambda.
      variance_weight: mu.
      covariance_weight: nu.

    Returns:
      The scalar loss and its three terms, unweighted.

    >>> z = jnp.array([[1.0, 1], [1, -1], [-1, 1], [-1, -1]])
    >>> vicreg_loss(z, z, jnp.ones(4, bool))[0]
    Array(0., dtype=float32)
    """
    chex.assert_equal_shape([z, z_next])
    z, z_next = mask_rows(z, valid), mask_rows(z_next, valid)
    width = z.shape[1]
    degrees = jnp.maximum(valid_count(valid, z.dtype) - 1, 1)
    similarity = masked_mean(jnp.mean((z - z_next) ** 2, axis=-1), valid)

    def variance_and_covariance(
        z: Float[Array, "B d"],
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        centred = mask_rows(z - masked_mean(z, valid)[None], valid)
        std = jnp.sqrt(masked_sum(centred**2, valid) / degrees + 1e-4)
        matrix = matmul(centred.T, centred) / degrees
        off_diagonal = jnp.where(jnp.eye(width, dtype=bool), 0.0, matrix)
        return jnp.mean(jax.nn.relu(1 - std)), jnp.sum(off_diagonal**2) / width

    terms = zip(variance_and_covariance(z), variance_and_covariance(z_next), strict=True)
    hinge, redundancy = (a + b for a, b in terms)
    total = invariance_weight * similarity + variance_weight * hinge
    return total + covariance_weight * redundancy, {
        "vicreg_invariance": similarity,
        "vicreg_variance": hinge,
        "vicreg_covariance": redundancy,
    }


def vicreg(
    invariance_weight: Weight = 1.0,
    variance_weight: Weight = 1.0,
    covariance_weight: Weight = 1 / 25,
) -> Objective:
    """Make the VICReg objective (eq. 5.7), without parameters of its own. See `vicreg_loss`.

    Args:
      invariance_weight: lambda, the weight of the distance between s_t and s_t+1.
      variance_weight: mu, the weight of the hinge on standard deviations.
      covariance_weight: nu, the weight of the covariances.

    >>> vicreg()
    vicreg(invariance_weight=1.0, variance_weight=1.0, covariance_weight=0.04)
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
        return vicreg_loss(features.z, features.z_next, batch.valid, **weights)

    weights = {
        "invariance_weight": invariance_weight,
        "variance_weight": variance_weight,
        "covariance_weight": covariance_weight,
    }
    return Objective(init, loss, name="vicreg", settings=weights)
