"""Hash codes of features: signs of random projections (SimHash)."""

import math

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray


def random_projection(key: PRNGKeyArray, inputs: int, outputs: int) -> Float[Array, "d k"]:
    """Draw a Gaussian map that keeps lengths on average: entries of variance 1/outputs.

    Args:
      key: of the draw.
      inputs: d.
      outputs: k.
    """
    return jax.random.normal(key, (inputs, outputs), jnp.float32) / math.sqrt(outputs)


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
