"""Spatio-temporal deep infomax with the regularisers of SND-STD (eq. 5.1-5.6)."""

import math
from typing import cast

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sndjax.products import dot_general, matmul
from sndjax.protocols import Encode, Objective
from sndjax.ranges import Weight
from sndjax.statistics import mask_rows, masked_mean, safe_sqrt, valid_count
from sndjax.types import Features, Loss, Params, Rollout, Transition

SLICE = 12  # positions whose [B, B] logits exist at once


def contrast(
    local: Float[Array, "B P C"],
    candidate: Float[Array, "B P C"] | Float[Array, "B 1 C"],
    valid: Bool[Array, " B"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Compute how well each state's true successor is distinguished from the batch's other states.

    The logits of position p are `local[:, p] @ candidate[:, p].T`, [B, B]; row b is
    softmaxed over the valid candidates and its cross-entropy against candidate b taken.

    Args:
      local: the local maps of s_t, one row per state and position.
      candidate: what they are compared with, of s_t+1; one for all positions where P is 1.
      valid: the rows and candidates that count.

    Returns:
      The cross-entropy, mean over valid rows and positions (eq. 5.1, 5.2 over IJ), and the
      Frobenius norm of the logits over valid pairs, mean over positions (eq. 5.4 over IJ).

    >>> contrast(jnp.zeros((8, 1, 4)), jnp.ones((8, 1, 4)), jnp.ones(8, bool))[0].round(4)
    Array(2.0794, dtype=float32)
    """
    local, candidate = mask_rows(local, valid), mask_rows(candidate, valid)
    positions = local.shape[1]
    pairs = valid[:, None] & valid[None, :]
    shared = candidate.shape[1] == 1

    @jax.checkpoint
    def position(
        local: Float[Array, "B C"], candidate: Float[Array, "B C"]
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        logits = matmul(local, candidate.T)
        allowed = jnp.where(valid[None, :], logits, -jnp.inf)
        # A row without a valid candidate is no row that counts; keep its softmax finite.
        allowed = jnp.where(valid[:, None], allowed, jnp.zeros_like(logits))
        true = jnp.diagonal(allowed)
        entropy = masked_mean(jax.nn.logsumexp(allowed, axis=-1) - true, valid)
        norm = safe_sqrt(jnp.sum(jnp.where(pairs, logits, jnp.zeros_like(logits)) ** 2))
        return entropy, norm

    def positions_slice(
        maps: tuple[Float[Array, "B P C"], Array],
    ) -> tuple[Float[Array, " P"], Float[Array, " P"]]:
        local, candidate = maps
        return jax.vmap(position, in_axes=(1, None if shared else 1))(
            local, candidate[:, 0] if shared else candidate
        )

    together = max(g for g in range(1, min(SLICE, positions) + 1) if positions % g == 0)

    def slices(x: Float[Array, "B IJ C"]) -> Float[Array, "S B P C"]:
        return jnp.moveaxis(x.reshape(x.shape[0], -1, together, x.shape[-1]), 1, 0)

    if shared:
        entropy, norm = lax.map(lambda x: positions_slice((x, candidate)), slices(local))
    else:
        entropy, norm = lax.map(positions_slice, (slices(local), slices(candidate)))
    return jnp.mean(entropy), jnp.mean(norm)


def feature_std_over_dims(z: Float[Array, "B d"], valid: Bool[Array, " B"]) -> Float[Array, ""]:
    """Compute the unbiased std over the d components of z_t, mean over valid rows (eq. 5.5).

    >>> feature_std_over_dims(jnp.array([[1.0, -1.0]]), jnp.array([True])).round(4)
    Array(1.4142, dtype=float32)
    """
    z = mask_rows(z, valid)
    centred = z - jnp.mean(z, axis=-1, keepdims=True)
    variance = jnp.sum(centred**2, axis=-1) / max(z.shape[-1] - 1, 1)
    return masked_mean(safe_sqrt(variance), valid)


def st_dim_loss(
    local: Float[Array, "B I J C"],
    local_mapped: Float[Array, "B I J C"],
    global_mapped: Float[Array, "B C"],
    z: Float[Array, "B d"],
    valid: Bool[Array, " B"],
    norm_weight: float = 1e-4,
    spread_weight: float = 1e-4,
) -> Loss:
    """Compute ST-DIM with both regularisers, means over positions and valid rows::

        L = L_GL + L_LL + beta_1 (p_GL + p_LL) - beta_2 mean_t std(z_t)          (5.6)

    Args:
      local: the local map of s_t.
      local_mapped: linear(C -> C) of the local map of s_t+1.
      global_mapped: linear(d -> C) of z_t+1. (Eq. 5.1 as printed takes the global side
        from s_t; ST-DIM's authors and the thesis' experiments take it from s_t+1.)
      z: the features of s_t.
      valid: the rows that count, as rows and as candidates.
      norm_weight: beta_1.
      spread_weight: beta_2.

    Returns:
      The scalar loss and its four terms, unweighted.
    """
    chex.assert_equal_shape([local, local_mapped])
    chex.assert_shape(global_mapped, (local.shape[0], local.shape[-1]))
    flat = lambda x: x.reshape(x.shape[0], -1, x.shape[-1])
    global_entropy, global_norm = contrast(flat(local), global_mapped[:, None], valid)
    local_entropy, local_norm = contrast(flat(local), flat(local_mapped), valid)
    spread = feature_std_over_dims(z, valid)
    norm = global_norm + local_norm
    total = global_entropy + local_entropy + norm_weight * norm - spread_weight * spread
    return total, {
        "st_dim_global_local": global_entropy,
        "st_dim_local_local": local_entropy,
        "st_dim_logit_norm": norm,
        "st_dim_spread": spread,
        "st_dim_chance": jnp.log(valid_count(valid, spread.dtype)),
    }


def fan_in_uniform(key: PRNGKeyArray, shape: tuple[int, ...], fan_in: int) -> Array:
    """Draw weights uniformly in +-1/sqrt(fan_in).

    Args:
      key: of the draw.
      shape: of the weights.
      fan_in: inputs of the layer.
    """
    bound = 1 / math.sqrt(fan_in)
    return jax.random.uniform(key, shape, jnp.float32, minval=-bound, maxval=bound)


class Projection(nn.Module):
    """A linear map whose weights and biases start uniform in +-1/sqrt(fan_in)."""

    features: int

    @nn.compact
    def __call__(self, x: Float[Array, "... n"]) -> Float[Array, "... m"]:
        fan_in = x.shape[-1]
        uniform = lambda key, shape, dtype=jnp.float32: fan_in_uniform(key, shape, fan_in)
        dense = nn.Dense(
            self.features,
            kernel_init=uniform,
            bias_init=uniform,
            dot_general=dot_general,
            name="Dense_0",
        )
        return dense(x)


def st_dim(norm_weight: Weight = 1e-4, spread_weight: Weight = 1e-4) -> Objective:
    """Make the ST-DIM objective (eq. 5.6); its parameters are two linear maps. See `st_dim_loss`.

    Args:
      norm_weight: beta_1, the weight of the norm of the logits.
      spread_weight: beta_2, the weight of the features' standard deviation.

    >>> st_dim()
    st_dim(norm_weight=0.0001, spread_weight=0.0001)
    """

    def init(key: PRNGKeyArray, features: Features, num_actions: int) -> Params:
        key_global, key_local = jax.random.split(key)
        projection = Projection(features.local.shape[-1])
        return {
            "global": projection.init(key_global, features.z_next),
            "local": projection.init(key_local, features.local_next),
        }

    def loss(
        params: Params,
        encode: Encode,
        features: Features,
        batch: Transition,
        rollout: Rollout,
        key: PRNGKeyArray,
    ) -> Loss:
        projection = Projection(features.local.shape[-1])
        return st_dim_loss(
            features.local,
            cast(Array, projection.apply(params["local"], features.local_next)),
            cast(Array, projection.apply(params["global"], features.z_next)),
            features.z,
            batch.valid,
            norm_weight,
            spread_weight,
        )

    settings = {"norm_weight": norm_weight, "spread_weight": spread_weight}
    return Objective(init, loss, name="st_dim", settings=settings)
