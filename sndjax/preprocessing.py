"""What a frame goes through before it enters an intrinsic module (section 5.2.2)."""

from collections.abc import Callable
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float, Shaped

from sndjax.convolution import to_float
from sndjax.statistics import std
from sndjax.types import RunningStatistics

Preprocess = Literal["none", "mean", "standardize", "standardize_wide"]
FARTHEST = 5.0  # deviations that a standardized vector is clipped to (Burda et al., 2018)


def make_preprocess(
    mode: Preprocess, moments: RunningStatistics | None
) -> Callable[[Shaped[Array, "B *frame"]], Shaped[Array, "B *frame"]]:
    """Return a function of a batch of frames, pixels being read as x / 255.

    - `none`: nothing. Pixels stay `uint8`; the first layer converts them.
    - `mean`: minus the running mean.
    - `standardize`: minus the running mean, over the running standard deviation, clipped to
      [-1, 1].
    - `standardize_wide`: the same clipped to [-5, 5] (Burda et al., 2018).

    >>> statistics = RunningStatistics(1.0, jnp.array([0.5]), jnp.zeros(1))
    >>> make_preprocess("mean", statistics)(jnp.ones((1, 1)))
    Array([[0.5]], dtype=float32)
    """
    if mode == "none" or moments is None:
        return lambda frame: frame

    def centre(frame: Shaped[Array, "B *frame"]) -> Float[Array, "B *frame"]:
        return to_float(frame) - moments.mean[None]

    if mode == "mean":
        return centre
    farthest = FARTHEST if mode == "standardize_wide" else 1.0
    return lambda frame: jnp.clip(centre(frame) / std(moments)[None], -farthest, farthest)


def standardize(
    frames: Shaped[Array, "*rows_frame"], moments: RunningStatistics
) -> Float[Array, "*rows_frame"]:
    """Compute clip((frames - mean) / std, -5, 5) with the running statistics of each component.

    >>> moments = RunningStatistics(jnp.array(4.0), jnp.array([1.0]), jnp.array([16.0]))
    >>> standardize(jnp.array([[3.0], [99.0]]), moments).ravel()
    Array([1., 5.], dtype=float32)
    """
    rows = tuple(range(frames.ndim - moments.mean.ndim))
    mean, deviation = (jnp.expand_dims(x, rows) for x in (moments.mean, std(moments)))
    far = (to_float(frames).astype(jnp.float32) - mean) / deviation
    return jnp.clip(far, -FARTHEST, FARTHEST)
