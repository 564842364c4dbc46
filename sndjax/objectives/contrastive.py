"""Contrastive pairs of augmented states, near and far: the objective of SND-V."""

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sndjax.convolution import to_float
from sndjax.protocols import Encode, Objective
from sndjax.ranges import Decay, Share, Weight
from sndjax.statistics import broadcast_mask, mask_rows
from sndjax.types import Features, Loss, Params, Rollout, Transition

TILES = (1, 2, 4, 8, 12, 16)  # sides in pixels; those that divide the image are used


def contrastive_loss(
    za: Float[Array, "P d"], zb: Float[Array, "P d"], far: Bool[Array, " P"], bound: float = 200.0
) -> Loss:
    """Compute the contrastive loss over P pairs: distance 0 if near, 1 if far, small features::

        L = mean_p (y_p - mean_j (za_pj - zb_pj)^2)^2
            + max(0, mean(za^2) + mean(zb^2) - bound),     y = 1 where far, else 0

    SND-V of the published experiments (article arXiv 2302.11563).

    Args:
      za: features of the first view of each pair.
      zb: features of the second view.
      far: the pair's states differ.
      bound: what the mean squares may reach together before they cost.

    Returns:
      The scalar loss and its two terms.

    >>> z = jnp.ones((2, 3))
    >>> contrastive_loss(z, z, jnp.array([False, True]))[0]
    Array(0.5, dtype=float32)
    """
    chex.assert_equal_shape([za, zb])
    distance = jnp.mean((za - zb) ** 2, axis=-1)
    contrast = jnp.mean((far.astype(za.dtype) - distance) ** 2)
    excess = jax.nn.relu(jnp.mean(za**2) + jnp.mean(zb**2) - bound)
    return contrast + excess, {"contrast": contrast, "contrast_excess": excess}


def draw_pairs(
    key: PRNGKeyArray, valid: Bool[Array, " M"], pairs: int
) -> tuple[Int[Array, " P"], Int[Array, " P"], Bool[Array, " P"]]:
    """Draw the rows of both states of each pair among the valid rows.

    The first half (rounded up) is far: two different rows, uniformly drawn. A near pair is one
    row twice. Where only one row is valid, far pairs are of that row too; with none, of row 0.

    Args:
      key: of the draws.
      valid: the rows that may be drawn.
      pairs: P.

    Returns:
      The row of each pair's first state, of its second, and which pairs are far.
    """
    key_one, key_other = jax.random.split(key)
    rank = jnp.cumsum(valid, dtype=jnp.int32)
    count = jnp.maximum(rank[-1], 1)
    row = lambda k: jnp.minimum(jnp.searchsorted(rank, k + 1), valid.shape[0] - 1)
    one = jax.random.randint(key_one, (pairs,), 0, count, jnp.int32)
    step = jax.random.randint(key_other, (pairs,), 1, jnp.maximum(count, 2), jnp.int32)
    far = jnp.arange(pairs) < (pairs + 1) // 2
    return row(one), row(jnp.where(far, (one + step) % count, one)), far


def augment(
    key: PRNGKeyArray, x: Float[Array, "P *frame"], noise: float = 0.2, erased: float = 0.1
) -> Float[Array, "P *frame"]:
    """Add tiles of zeros, then uniform noise, each to half of the samples; no clipping.

    Tiles are square, of one side per call; the tiles of a vector are its elements.

    Args:
      key: of the draws.
      x: the samples.
      noise: the largest size of the noise; pixels are in [0, 1].
      erased: the probability that a tile is zero.
    """
    key_tiled, key_tile, key_side, key_noised, key_noise = jax.random.split(key, 5)
    samples, probability = x.shape[0], jnp.float32(erased)
    if x.ndim == 4:
        height, width = x.shape[1:3]
        fitting = [s for s in TILES if height % s == 0 and width % s == 0]
        sides = jnp.array(fitting, jnp.int32)
        side = sides[jax.random.randint(key_side, (), 0, len(fitting), jnp.int32)]
        drawn = jax.random.bernoulli(key_tile, probability, (samples, height, width))
        rows, columns = jnp.arange(height) // side, jnp.arange(width) // side
        zeroed = drawn[:, rows][:, :, columns][..., None]
    else:
        zeroed = jax.random.bernoulli(key_tile, probability, x.shape)
    half = jnp.float32(0.5)
    tiled = jax.random.bernoulli(key_tiled, half, (samples,))
    x = jnp.where(broadcast_mask(tiled, x) & zeroed, jnp.zeros_like(x), x)
    added = jax.random.uniform(key_noise, x.shape, jnp.float32, -noise, noise)
    noised = jax.random.bernoulli(key_noised, half, (samples,))
    return jnp.where(broadcast_mask(noised, x), x + added.astype(x.dtype), x)


def contrastive(
    bound: Weight = 200.0, pairs: Share = 1 / 8, noise: Weight = 0.2, erased: Decay = 0.1
) -> Objective:
    """Make the objective of SND-V: B/8 pairs of the whole rollout, drawn for each minibatch.

    It reads neither the minibatch nor any s_t+1. See `contrastive_loss`. Without any valid row in
    the rollout the loss is 0.

    Args:
      bound: what the mean squares of both views may reach together before they cost.
      pairs: of a minibatch, at least 2, in units of its rows.
      noise: the largest size of the noise on half of the views; pixels are in [0, 1].
      erased: the probability that a tile of the other half's views is zero.

    >>> contrastive().needs_pairs
    False
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
        key_pairs, key_one, key_other = jax.random.split(key, 3)
        count = max(2, int(batch.valid.shape[0] * pairs))
        one, other, far = draw_pairs(key_pairs, rollout.valid.reshape(-1), count)
        frames = rollout.frames.reshape(-1, *rollout.frames.shape[2:])
        some = jnp.any(rollout.valid)
        drawn = lambda rows: mask_rows(to_float(frames[rows]), jnp.broadcast_to(some, (count,)))
        za, _ = encode(augment(key_one, drawn(one), noise, erased))
        zb, _ = encode(augment(key_other, drawn(other), noise, erased))
        total, terms = contrastive_loss(za, zb, far, bound)
        return jnp.where(some, total, jnp.zeros_like(total)), terms

    settings = {"bound": bound, "pairs": pairs, "noise": noise, "erased": erased}
    return Objective(init, loss, needs_pairs=False, name="contrastive", settings=settings)
