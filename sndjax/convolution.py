"""The one place that knows how a convolution is lowered on each backend.

On a CPU a convolution is patches times weights, a slice of the batch at a time:
the patches of a slice stay in the cache, bias and activation are applied there, and
unlike XLA's native CPU convolution the product is as fast inside a loop as outside
one. Everywhere else it is the native convolution. The tests hold the two equal.
"""

from collections.abc import Callable
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Shaped

SLICE = 8  # images whose patches are in the cache at once

Activation = Literal["elu", "relu", "none"]
ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "elu": jax.nn.elu,
    "relu": jax.nn.relu,
    "none": lambda x: x,
}
# The derivative of each activation as a function of its output.
SLOPES: dict[str, Callable[[Array], Array]] = {
    "elu": lambda y: jnp.where(y > 0, jnp.ones_like(y), y + 1),
    "relu": lambda y: (y > 0).astype(y.dtype),
    "none": jnp.ones_like,
}


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
            x[
                :,
                i : i + stride * (rows - 1) + 1 : stride,
                j : j + stride * (columns - 1) + 1 : stride,
            ]
            for i in range(size)
            for j in range(size)
        ],
        axis=-1,
    )


def slices(x: Shaped[Array, "B *rest"]) -> Shaped[Array, "M m *rest"]:
    """A batch cut into the slices that are worked on one after another."""
    return x.reshape(-1, min(SLICE, x.shape[0]), *x.shape[1:])


def weigh(images: Array, kernel: Array, bias: Array, stride: int, padding: int, activation: str):
    """One slice's output: activation(patches times weights + bias)."""
    neighbourhoods = to_float(patches(images, kernel.shape[0], stride, padding))
    y = neighbourhoods @ kernel.reshape(-1, kernel.shape[-1])
    return ACTIVATIONS[activation](y + bias[None, None, None, :])


@partial(jax.custom_vjp, nondiff_argnums=(3, 4, 5))
def sliced(x: Array, kernel: Array, bias: Array, stride: int, padding: int, activation: str):
    """The layer on a batch of whole slices, slice by slice.

    The backward pass keeps inputs and outputs alone: the slope of the activation is read
    off its output, and patches are made again while their slice is in the cache.
    """
    apply = lambda images: weigh(images, kernel, bias, stride, padding, activation)
    y = lax.map(apply, slices(x))
    return y.reshape(-1, *y.shape[2:])


def sliced_forward(x, kernel, bias, stride, padding, activation):
    """The layer, and what its backward pass needs."""
    y = sliced(x, kernel, bias, stride, padding, activation)
    return y, (x, kernel, bias, y)


def sliced_backward(stride, padding, activation, kept, gradient):
    """The gradients in x (none for pixels), kernel and bias, slice by slice."""
    x, kernel, bias, y = kept
    size, outputs = kernel.shape[0], kernel.shape[-1]
    weights = kernel.reshape(-1, outputs)
    gather = lambda images: to_float(patches(images, size, stride, padding))
    pixels = x.dtype == jnp.uint8

    def step(total, part):
        images, y, gradient = part
        gradient = gradient * SLOPES[activation](y)
        flat = gradient.reshape(-1, outputs)
        neighbourhoods = gather(images).reshape(-1, weights.shape[0])
        total = (total[0] + neighbourhoods.T @ flat, total[1] + jnp.sum(flat, axis=0))
        if pixels:
            return total, None
        (back,) = jax.linear_transpose(gather, images)(gradient @ weights.T)
        return total, back

    start = (jnp.zeros_like(weights), jnp.zeros_like(bias))
    (d_weights, d_bias), d_x = lax.scan(step, start, (slices(x), slices(y), slices(gradient)))
    d_x = np.zeros(x.shape, jax.dtypes.float0) if pixels else d_x.reshape(x.shape)
    return d_x, d_weights.reshape(kernel.shape), d_bias


sliced.defvjp(sliced_forward, sliced_backward)


def convolve_patches(x, kernel, bias, stride, padding, activation):
    """`convolve` as patches times weights, sliced over the batch."""
    count = x.shape[0]
    short = -count % min(SLICE, count)
    x = jnp.pad(x, ((0, short), (0, 0), (0, 0), (0, 0)))
    return sliced(x, kernel, bias, stride, padding, activation)[:count]


def convolve_native(x, kernel, bias, stride, padding, activation):
    """`convolve` as XLA's own operation."""
    y = lax.conv_general_dilated(
        to_float(x).astype(kernel.dtype),
        kernel,
        (stride, stride),
        ((padding, padding), (padding, padding)),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )
    return ACTIVATIONS[activation](y + bias[None, None, None, :])


def convolve(
    x: Shaped[Array, "B H W C"],
    kernel: Float[Array, "k k C O"],
    bias: Float[Array, " O"],
    stride: int,
    padding: int,
    activation: Activation,
) -> Float[Array, "B I J O"]:
    """A convolutional layer: activation(x * kernel + bias), `*` the cross-correlation.

    Args:
      x: `uint8` pixels (read as x / 255) or `float32`, channels last.
      kernel: `[k, k, C, O]`.
      bias: `[O]`.
      stride: the step between neighbourhoods, in pixels.
      padding: zeros added on each side, in pixels.
      activation: "elu", "relu" or "none".

    Returns:
      `[B, I, J, O]` with `I = (H + 2 * padding - k) // stride + 1`, `J` likewise.

    >>> x, kernel = jnp.ones((2, 4, 4, 1)), jnp.ones((3, 3, 1, 5))
    >>> convolve(x, kernel, jnp.zeros(5), stride=2, padding=1, activation="relu").shape
    (2, 2, 2, 5)
    """
    lowering = convolve_patches if jax.default_backend() == "cpu" else convolve_native
    return lowering(x, kernel, bias, stride, padding, activation)
