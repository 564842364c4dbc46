"""Means over valid rows, running moments, and the scaling of a reward by its return."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from sndjax.types import Moments, ReturnScale


def expand(mask: Bool[Array, "*rows"], like: Array) -> Array:
    """The mask with trailing axes of size one, so that it meets `like`."""
    return mask.reshape(mask.shape + (1,) * (like.ndim - mask.ndim))


def masked_sum(x: Float[Array, "B *rest"], valid: Bool[Array, " B"]) -> Float[Array, "*rest"]:
    """Sum over the valid rows; what the others hold, NaN included, does not matter."""
    return jnp.sum(jnp.where(expand(valid, x), x, jnp.zeros_like(x)), axis=0)


def valid_count(valid: Bool[Array, "*rows"], dtype=jnp.float32) -> Float[Array, ""]:
    """The number of valid rows, at least 1, so that it can divide."""
    return jnp.maximum(jnp.sum(valid, dtype=dtype), 1)


def masked_mean(x: Float[Array, "B *rest"], valid: Bool[Array, " B"]) -> Float[Array, "*rest"]:
    """Mean over the valid rows, 0 where there are none.

    >>> masked_mean(jnp.array([1.0, 3.0, jnp.nan]), jnp.array([True, True, False]))
    Array(2., dtype=float32)
    """
    return masked_sum(x, valid) / valid_count(valid, x.dtype)


def safe_sqrt(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Square root whose gradient at 0 is 0 instead of infinite.

    >>> import jax
    >>> jax.grad(safe_sqrt)(jnp.zeros(()))
    Array(0., dtype=float32)
    """
    positive = x > 0
    return jnp.where(
        positive, jnp.sqrt(jnp.where(positive, x, jnp.ones_like(x))), jnp.zeros_like(x)
    )


def no_moments(shape: tuple[int, ...]) -> Moments:
    """Moments of nothing yet."""
    return Moments(jnp.zeros(()), jnp.zeros(shape), jnp.zeros(shape))


def merge_moments(a: Moments, b: Moments) -> Moments:
    """Moments of the samples of both (Chan, Golub and LeVeque, 1979)."""
    count = a.samples + b.samples
    share = b.samples / jnp.maximum(count, 1)
    distance = b.mean - a.mean
    mean = a.mean + share * distance
    m2 = a.m2 + b.m2 + a.samples * share * distance**2
    return Moments(count, mean, m2)


def batch_moments(x: Float[Array, "B *shape"], valid: Bool[Array, " B"]) -> Moments:
    """Moments of the valid rows of one batch."""
    mean = masked_mean(x, valid)
    return Moments(jnp.sum(valid, dtype=x.dtype), mean, masked_sum((x - mean[None]) ** 2, valid))


def feature_spread(z: Float[Array, "B d"], valid: Bool[Array, " B"]) -> Float[Array, ""]:
    """How far features are apart: sqrt(mean over d of their variance over the valid rows).

    >>> feature_spread(jnp.array([[0.0, 3.0], [4.0, 3.0]]), jnp.array([True, True]))
    Array(1.4142135, dtype=float32)
    """
    moments = batch_moments(z, valid)
    return jnp.sqrt(jnp.mean(moments.m2 / jnp.maximum(moments.samples, 1)))


def update_moments(
    moments: Moments, x: Array, valid: Bool[Array, "T N"], to_float=lambda x: x
) -> Moments:
    """Take in the valid rows of `x[T, N, *shape]`, converted one time step at a time."""

    def step(total, row):
        return merge_moments(total, batch_moments(to_float(row[0]), row[1])), None

    seen, _ = lax.scan(step, no_moments(moments.mean.shape), (x, valid))
    return merge_moments(moments, seen)


def deviation(moments: Moments) -> Float[Array, "*shape"]:
    """Standard deviation over the samples seen, 1 where none or no spread was seen.

    >>> deviation(no_moments((2,)))
    Array([1., 1.], dtype=float32)
    """
    variance = moments.m2 / jnp.maximum(moments.samples, 1)
    return jnp.where(variance > 0, jnp.sqrt(jnp.where(variance > 0, variance, 1)), 1)


def init_return_scale(num_envs: int) -> ReturnScale:
    """The scale before any reward was seen."""
    return ReturnScale(no_moments(()), jnp.zeros(num_envs))


def update_return_scale(
    scale: ReturnScale, reward: Float[Array, "T N"], valid: Bool[Array, "T N"], discount: float
) -> ReturnScale:
    """Follow the discounted sum R_t = discount * R_t-1 + r_t of every environment over time.

    The sum goes on across episodes and stands still on reset rows (Burda et al., 2018).
    """

    def step(discounted, row):
        reward, valid = row
        discounted = jnp.where(valid, discount * discounted + reward, discounted)
        return discounted, discounted

    discounted, sums = lax.scan(step, scale.discounted, (reward, valid))
    return ReturnScale(update_moments(scale.moments, sums, valid), discounted)
