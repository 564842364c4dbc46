"""Means over valid rows, running statistics, and the statistics of a reward's return."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Shaped

from sndjax.types import ReturnStatistics, RunningStatistics

ROUNDINGS = 8  # a deviation below so many roundings of the mean counts as none


def broadcast_mask(mask: Bool[Array, "*rows"], like: Array) -> Array:
    """Return the mask with trailing axes of size one, so that it broadcasts against `like`."""
    return mask.reshape(mask.shape + (1,) * (like.ndim - mask.ndim))


def mask_rows(x: Shaped[Array, "*rows_rest"], valid: Bool[Array, "*rows"]) -> Array:
    """Replace the rows that are not valid by zeros.

    A loss does this to its inputs, before it squares them: a mask on the result alone leaves a NaN
    in the gradient, because 0 times NaN is NaN in the backward pass.

    >>> mask_rows(jnp.array([1.0, jnp.nan]), jnp.array([True, False]))
    Array([1., 0.], dtype=float32)
    """
    return jnp.where(broadcast_mask(valid, x), x, jnp.zeros_like(x))


def masked_sum(x: Float[Array, "B *rest"], valid: Bool[Array, " B"]) -> Float[Array, "*rest"]:
    """Sum over the valid rows; what the others hold, NaN included, is ignored."""
    return jnp.sum(mask_rows(x, valid), axis=0)


def valid_count(valid: Bool[Array, "*rows"], dtype: DTypeLike = jnp.float32) -> Float[Array, ""]:
    """Count the valid rows, at least 1, so that it can divide."""
    return jnp.maximum(jnp.sum(valid, dtype=dtype), 1)


def masked_mean(x: Float[Array, "B *rest"], valid: Bool[Array, " B"]) -> Float[Array, "*rest"]:
    """Average over the valid rows, 0 where there are none.

    >>> masked_mean(jnp.array([1.0, 3.0, jnp.nan]), jnp.array([True, True, False]))
    Array(2., dtype=float32)
    """
    return masked_sum(x, valid) / valid_count(valid, x.dtype)


def safe_sqrt(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Take the square root, with gradient 0 at 0 instead of infinity.

    >>> import jax
    >>> jax.grad(safe_sqrt)(jnp.zeros(()))
    Array(0., dtype=float32)
    """
    positive = x > 0
    return jnp.where(
        positive, jnp.sqrt(jnp.where(positive, x, jnp.ones_like(x))), jnp.zeros_like(x)
    )


def init_running_statistics(shape: tuple[int, ...]) -> RunningStatistics:
    """Return the running statistics of no sample yet."""
    zero = lambda shape: jnp.zeros(shape, jnp.float32)
    return RunningStatistics(zero(()), zero(shape), zero(shape))


def init_unit_statistics(shape: tuple[int, ...]) -> RunningStatistics:
    """Return statistics that begin with mean 0 and variance 1, as gymnasium's `RunningMeanStd`.

    They weigh as much as 1e-4 of a sample.
    """
    few = jnp.float32(1e-4)
    return RunningStatistics(few, jnp.zeros(shape, jnp.float32), jnp.full(shape, few))


def merge_statistics(a: RunningStatistics, b: RunningStatistics) -> RunningStatistics:
    """Merge the statistics of two sets of samples (Chan, Golub and LeVeque, 1979)."""
    count = a.samples + b.samples
    share = b.samples / jnp.maximum(count, 1)
    distance = b.mean - a.mean
    mean = a.mean + share * distance
    m2 = a.m2 + b.m2 + a.samples * share * distance**2
    return RunningStatistics(count, mean, m2)


def batch_statistics(x: Float[Array, "B *shape"], valid: Bool[Array, " B"]) -> RunningStatistics:
    """Compute the statistics of the valid rows of one batch."""
    mean = masked_mean(x, valid)
    return RunningStatistics(
        jnp.sum(valid, dtype=x.dtype), mean, masked_sum((x - mean[None]) ** 2, valid)
    )


def feature_std_over_batch(z: Float[Array, "B d"], valid: Bool[Array, " B"]) -> Float[Array, ""]:
    """Compute sqrt(mean over d of the features' variance over the valid rows).

    >>> feature_std_over_batch(jnp.array([[0.0, 3.0], [4.0, 3.0]]), jnp.array([True, True]))
    Array(1.4142135, dtype=float32)
    """
    moments = batch_statistics(z, valid)
    return jnp.sqrt(jnp.mean(moments.m2 / jnp.maximum(moments.samples, 1)))


def update_running_statistics(
    moments: RunningStatistics,
    x: Shaped[Array, "T N *shape"],
    valid: Bool[Array, "T N"],
    to_float: Callable[[Array], Array] = lambda x: x,
) -> RunningStatistics:
    """Add the valid rows of x to the running statistics.

    Args:
      moments: the statistics so far.
      x: T steps of N samples.
      valid: the rows that count.
      to_float: converts x, one time step at a time.
    """

    def step(total: RunningStatistics, row: tuple[Array, Array]) -> tuple[RunningStatistics, None]:
        x = to_float(row[0]).astype(total.mean.dtype)
        return merge_statistics(total, batch_statistics(x, row[1])), None

    nothing = RunningStatistics(*map(jnp.zeros_like, moments))
    seen, _ = lax.scan(step, nothing, (x, valid))
    return merge_statistics(moments, seen)


def std(moments: RunningStatistics) -> Float[Array, "*shape"]:
    """Compute the standard deviation of the samples seen, 1 where no variance was seen.

    A deviation of less than a few roundings of the mean is no variance: it is what the arithmetic
    makes of a constant. Divided by it, a constant 9.81 would become 10 million.

    >>> std(init_running_statistics((2,)))
    Array([1., 1.], dtype=float32)
    >>> std(RunningStatistics(jnp.array(9.0), jnp.array([9.81, 0.0]), jnp.array([9e-12, 9e-12])))
    Array([1.e+00, 1.e-06], dtype=float32)
    """
    variance = moments.m2 / jnp.maximum(moments.samples, 1)
    rounding = ROUNDINGS * jnp.finfo(variance.dtype).eps * moments.mean
    spread = variance > rounding**2
    return jnp.where(spread, jnp.sqrt(jnp.where(spread, variance, 1)), 1)


def init_return_statistics(num_envs: int) -> ReturnStatistics:
    """Return the statistics before any reward was seen."""
    return ReturnStatistics(init_running_statistics(()), jnp.zeros(num_envs, jnp.float32))


def update_return_statistics(
    scale: ReturnStatistics, reward: Float[Array, "T N"], valid: Bool[Array, "T N"], discount: float
) -> ReturnStatistics:
    """Add the discounted sums R_t = discount * R_t-1 + r_t of every environment over time.

    The sum continues across episodes and skips reset rows (Burda et al., 2018).

    Args:
      scale: the statistics so far.
      reward: r_t.
      valid: False on reset rows.
      discount: gamma.
    """

    def step(
        discounted: Float[Array, " N"], row: tuple[Array, Array]
    ) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
        reward, valid = row
        discounted = jnp.where(valid, discount * discounted + reward, discounted)
        return discounted, discounted

    discounted, sums = lax.scan(step, scale.discounted, (reward, valid))
    return ReturnStatistics(update_running_statistics(scale.moments, sums, valid), discounted)
