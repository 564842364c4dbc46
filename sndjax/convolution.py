"""The one place that knows how a convolution is lowered on each backend.

On a CPU a convolution is patches times weights, a slice of the batch at a time:
the patches of a slice stay in the cache, they are made again in the backward pass
instead of being kept, and unlike XLA's native CPU convolution the product is as
fast inside a loop as outside one. Everywhere else it is the native convolution.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Shaped

SLICE = 16  # images whose patches are in the cache at once


def to_float(x: Shaped[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Pixels `uint8` become `float32` in [0, 1]; anything else passes through.

    >>> to_float(jnp.array([0, 255], jnp.uint8))
    Array([0., 1.], dtype=float32)
    """
    return x.astype(jnp.float32) / 255.0 if x.dtype == jnp.uint8 else x


def patches(x: Shaped[Array, "B H W C"], size: int, stride: int, padding: int):
    """The `size` x `size` neighbourhoods of an image, as `[B, I, J, size * size * C]`."""
    _, height, width, _ = x.shape
    rows = (height + 2 * padding - size) // stride + 1
    columns = (width + 2 * padding - size) // stride + 1
    x = jnp.pad(x, ((0, 0), (padding, padding), (padding, padding), (0, 0)))
    return jnp.concatenate(
        [
            x[:, i : i + stride * (rows - 1) + 1 : stride, j : j + stride * (columns - 1) + 1 : stride]
            for i in range(size)
            for j in range(size)
        ],
        axis=-1,
    )


def convolve_patches(
    x: Shaped[Array, "B H W C"], kernel: Float[Array, "k k C O"], stride: int, padding: int
) -> Float[Array, "B I J O"]:
    """Convolution as patches times weights, sliced over the batch."""
    weights = kernel.reshape(-1, kernel.shape[-1])

    @jax.checkpoint
    def product(images):
        return to_float(patches(images, kernel.shape[0], stride, padding)) @ weights

    count = x.shape[0]
    if count <= SLICE:
        return product(x)
    x = jnp.pad(x, ((0, -count % SLICE), (0, 0), (0, 0), (0, 0)))
    y = lax.map(product, x.reshape(-1, SLICE, *x.shape[1:]))
    return y.reshape(-1, *y.shape[2:])[:count]


def convolve_native(
    x: Shaped[Array, "B H W C"], kernel: Float[Array, "k k C O"], stride: int, padding: int
) -> Float[Array, "B I J O"]:
    """Convolution as XLA's own operation."""
    return lax.conv_general_dilated(
        to_float(x),
        kernel,
        (stride, stride),
        ((padding, padding), (padding, padding)),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )


def convolve(
    x: Shaped[Array, "B H W C"], kernel: Float[Array, "k k C O"], stride: int, padding: int
) -> Float[Array, "B I J O"]:
    """Cross-correlation of a batch of images with square kernels.

    Args:
      x: `uint8` pixels (read as x / 255) or `float32`, channels last.
      kernel: `[k, k, C, O]`.
      stride: the step between neighbourhoods, in pixels.
      padding: zeros added on each side, in pixels.

    Returns:
      `[B, I, J, O]` with `I = (H + 2 * padding - k) // stride + 1`, `J` likewise.

    >>> convolve(jnp.ones((2, 4, 4, 1)), jnp.ones((3, 3, 1, 5)), stride=2, padding=1).shape
    (2, 2, 2, 5)
    """
    lowering = convolve_patches if jax.default_backend() == "cpu" else convolve_native
    return lowering(x, kernel, stride, padding)
