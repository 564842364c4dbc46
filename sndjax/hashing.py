"""Hash codes of features: signs of random projections of centred features (SimHash)."""

import math

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sndjax.statistics import update_running_statistics
from sndjax.types import RunningStatistics


def random_projection(key: PRNGKeyArray, inputs: int, outputs: int) -> Float[Array, "d k"]:
    """Draw a Gaussian map that keeps lengths on average: entries of variance 1/outputs.

    Args:
      key: of the draw.
      inputs: d.
      outputs: k.
    """
    return jax.random.normal(key, (inputs, outputs), jnp.float32) / math.sqrt(outputs)


def centre_features(
    z: Float[Array, "T1 N d"], seen: RunningStatistics | None, valid: Bool[Array, "T N"]
) -> tuple[Float[Array, "T1 N d"], RunningStatistics | None]:
    """Subtract the running mean of features, this rollout's valid rows included.

    Features of pixels share a large mean. Without it their signs differ; with it most states have
    the same signs.

    Args:
      z: features of s_0 ... s_T, or of s_0 ... s_T-1.
      seen: the running statistics of features so far; None: z is returned as it is.
      valid: the rows that count.

    Returns:
      The centred features and the new statistics.
    """
    if seen is None:
        return z, None
    seen = update_running_statistics(seen, z[: valid.shape[0]], valid)
    return z - seen.mean[None, None], seen


def simhash_code(
    z: Float[Array, "*rows d"], projection: Float[Array, "d k"]
) -> Int[Array, "*rows"]:
    """Compute the k signs of z A as a number below 2^k: Phi(s) = sgn(A g(s)) of eq. 4.18.

    >>> simhash_code(jnp.array([[1.0, -1.0], [-1.0, 1.0]]), jnp.eye(2))
    Array([1, 2], dtype=int32)
    """
    chex.assert_rank(projection, 2)
    signs = (z @ projection > 0).astype(jnp.int32)
    return signs @ (1 << jnp.arange(projection.shape[1], dtype=jnp.int32))
