"""Variance-invariance-covariance regularisation of consecutive states (eq. 3.12-3.15, 5.7)."""

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sndjax.statistics import expand, masked_mean, masked_sum, valid_count
from sndjax.types import Metrics, Objective


def vicreg_loss(
    z: Float[Array, "B d"],
    z_next: Float[Array, "B d"],
    valid: Bool[Array, " B"],
    invariance: float = 1.0,
    variance: float = 1.0,
    covariance: float = 1 / 25,
) -> tuple[Float[Array, ""], Metrics]:
    """VICReg on the features of s_t and s_t+1, over the n valid rows::

        L   = lambda s(Z, Z') + mu [v(Z) + v(Z')] + nu [c(Z) + c(Z')]            (5.7)
        s   = 1/(n d) sum_i ||z_i - z'_i||^2                                     (3.14)
        v   = 1/d sum_j max(0, 1 - sqrt(var_j + 1e-4))                           (3.12)
        c   = 1/d sum_{i != j} C_ij^2,  C the covariance with 1/(n - 1)          (3.13)

    The variance is unbiased too. (Bardes et al., 2022.)

    Args:
      z, z_next: features of s_t and of s_t+1.
      valid: the rows that count.
      invariance, variance, covariance: lambda, mu and nu.

    Returns:
      The scalar loss and its three terms, unweighted.

    >>> z = jnp.array([[1.0, 1], [1, -1], [-1, 1], [-1, -1]])
    >>> vicreg_loss(z, z, jnp.ones(4, bool))[0]
    Array(0., dtype=float32)
    """
    chex.assert_equal_shape([z, z_next])
    width = z.shape[1]
    degrees = jnp.maximum(valid_count(valid, z.dtype) - 1, 1)
    similarity = masked_mean(jnp.mean((z - z_next) ** 2, axis=-1), valid)

    def spread(z):
        centred = z - masked_mean(z, valid)[None]
        centred = jnp.where(expand(valid, z), centred, jnp.zeros_like(z))
        deviation = jnp.sqrt(masked_sum(centred**2, valid) / degrees + 1e-4)
        matrix = centred.T @ centred / degrees
        off_diagonal = jnp.where(jnp.eye(width, dtype=bool), 0.0, matrix)
        return jnp.mean(jax.nn.relu(1 - deviation)), jnp.sum(off_diagonal**2) / width

    hinge, redundancy = (a + b for a, b in zip(spread(z), spread(z_next), strict=True))
    total = invariance * similarity + variance * hinge + covariance * redundancy
    return total, {
        "vicreg_invariance": similarity,
        "vicreg_variance": hinge,
        "vicreg_covariance": redundancy,
    }


def vicreg(invariance: float = 1.0, variance: float = 1.0, covariance: float = 1 / 25) -> Objective:
    """The VICReg objective (eq. 5.7), without parameters of its own. See `vicreg_loss`.

    >>> vicreg().init(None, None, 18)
    {}
    """

    def init(key, features, num_actions):
        return {}

    def loss(params, encode, features, batch, rollout, key):
        return vicreg_loss(
            features.z, features.z_next, batch.valid, invariance, variance, covariance
        )

    return Objective(init, loss)
