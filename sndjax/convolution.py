"""The convolution: patches times weights.

On a CPU a few images go through all layers before the next do:
what one layer hands to the next stays in the cache, and unlike XLA's native CPU convolution
the products are as fast inside a loop as outside one. Elsewhere a minibatch goes through whole.
On a GPU the native convolution would be 7% faster for one agent, but under vmap over agents,
each with its own kernel, it becomes a grouped one, and 22 times slower than one agent after
another (docs/results/speed.md). The tests hold the two equal.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Shaped

from sndjax.activations import ACTIVATIONS, SLOPES, Activation
from sndjax.products import matmul

CPU_SLICE = 8  # images that are in a CPU's cache at once
DEVICE_SLICE = 1024  # images at once elsewhere: any minibatch of the thesis


class Convolution(NamedTuple):
    """One convolutional layer: channels out, kernel side, stride and padding in pixels."""

    channels: int
    size: int = 3
    stride: int = 1
    padding: int = 1


Layers = tuple[Convolution, ...]
Weights = tuple[tuple[Array, Array], ...]  # the kernel [k, k, C, O] and the bias [O] of each

PIXELS = 16  # the smallest side of an image of integers that are no uint8


def to_float(x: Shaped[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Convert frames to floats.

    Pixels become `float32` in [0, 1]: `uint8` always, other integers in frames [H, W, C] from
    16x16 on. Other integers and booleans keep their values. Floats stay: images must be in [0, 1].

    >>> to_float(jnp.array([0, 255], jnp.uint8))
    Array([0., 1.], dtype=float32)
    """
    if jnp.issubdtype(x.dtype, jnp.floating):
        return x
    image = x.ndim >= 4 and min(x.shape[-3:-1]) >= PIXELS
    pixels = x.dtype == jnp.uint8 or (jnp.issubdtype(x.dtype, jnp.integer) and image)
    return x.astype(jnp.float32) / 255.0 if pixels else x.astype(jnp.float32)


def patches(x: Shaped[Array, "B H W C"], layer: Convolution) -> Float[Array, "B I J K"]:
    """Gather the neighbourhoods that a layer weighs, K = size * size * C, as floats."""
    _, size, stride, padding = layer
    _, height, width, _ = x.shape
    rows = (height + 2 * padding - size) // stride + 1
    columns = (width + 2 * padding - size) // stride + 1
    x = jnp.pad(x, ((0, 0), (padding, padding), (padding, padding), (0, 0)))
    neighbourhoods = jnp.concatenate(
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
    return to_float(neighbourhoods)


def slice_count(images: int) -> int:
    """Return into how many slices of the same size so many images go."""
    return -(-images // (CPU_SLICE if jax.default_backend() == "cpu" else DEVICE_SLICE))


def slices(x: Shaped[Array, "B *rest"]) -> Shaped[Array, "M m *rest"]:
    """Cut a batch into the slices that are worked on one after another."""
    return x.reshape(slice_count(x.shape[0]), -1, *x.shape[1:])


def merge_slices(x: Shaped[Array, "M m *rest"]) -> Shaped[Array, "B *rest"]:
    """Join slices to a batch."""
    return x.reshape(-1, *x.shape[2:])


def apply_layers(
    images: Array, weights: Weights, layers: Layers, activation: Activation
) -> tuple[list[Array], list[Array]]:
    """Apply the layers to one slice.

    Args:
      images: the slice, channels last.
      weights: of each layer.
      layers: their sizes.
      activation: after each layer.

    Returns:
      The maps, activation(patches times weights + bias) of each layer, and the patches.
    """
    maps, gathered = [], []
    for (kernel, bias), layer in zip(weights, layers, strict=True):
        gathered.append(patches(images, layer))
        y = matmul(gathered[-1], kernel.reshape(-1, layer.channels))
        images = ACTIVATIONS[activation](y + bias[None, None, None, :])
        maps.append(images)
    return maps, gathered


def select_outputs(maps: list[Array], output_layers: tuple[int, ...]) -> tuple[Array, ...]:
    """Return the maps of some layers, counted from the first."""
    return tuple(maps[i] for i in output_layers)


@partial(jax.custom_vjp, nondiff_argnums=(2, 3, 4))
def conv_in_slices(
    x: Array,
    weights: Weights,
    layers: Layers,
    activation: Activation,
    output_layers: tuple[int, ...],
) -> tuple[Array, ...]:
    """Apply the layers to a batch of whole slices, slice by slice. See `convolve`.

    Args:
      x: images.
      weights: of each layer.
      layers: their sizes.
      activation: after each layer.
      output_layers: the layers whose maps are returned.
    """

    def apply(images: Array) -> tuple[Array, ...]:
        maps, _ = apply_layers(images, weights, layers, activation)
        return select_outputs(maps, output_layers)

    return jax.tree.map(merge_slices, lax.map(apply, slices(x)))


def conv_in_slices_forward(
    x: Array,
    weights: Weights,
    layers: Layers,
    activation: Activation,
    output_layers: tuple[int, ...],
) -> tuple[tuple[Array, ...], Any]:
    """Apply the layers, and keep what the backward pass needs.

    That is every map but the first one, which is the largest and the cheapest to make again.

    Args:
      x: images.
      weights: of each layer.
      layers: their sizes.
      activation: after each layer.
      output_layers: the layers whose maps are returned.

    Returns:
      The maps, and the images, the weights and the kept maps.
    """
    again = 0 if 0 in output_layers else 1
    apply = lambda images: apply_layers(images, weights, layers, activation)[0][again:]
    maps = jax.tree.map(merge_slices, lax.map(apply, slices(x)))
    return select_outputs([x] * again + maps, output_layers), (x, weights, maps)


def conv_in_slices_backward(
    layers: Layers,
    activation: Activation,
    output_layers: tuple[int, ...],
    kept: Any,
    gradients: tuple[Array, ...],
) -> tuple[Any, Any]:
    """Compute the gradients in x (none for pixels) and in the weights, slice by slice.

    The slope of an activation is read off its output; patches are made again.

    Args:
      layers: their sizes.
      activation: after each layer.
      output_layers: the layers whose maps were returned.
      kept: by the forward pass.
      gradients: of the returned maps.
    """
    x, weights, maps = kept
    again = len(layers) - len(maps)
    pixels = x.dtype == jnp.uint8

    def step(total: Any, part: Any) -> tuple[Any, Array | None]:
        images, maps, gradients = part
        made, gathered = apply_layers(images, weights[:again], layers[:again], activation)
        maps = [images, *made, *maps]
        found, gradient = [], jnp.zeros_like(maps[-1])
        for i in reversed(range(len(layers))):
            kernel = weights[i][0].reshape(-1, layers[i].channels)
            own = [g for j, g in zip(output_layers, gradients, strict=True) if j == i]
            gradient = sum(own, gradient) * SLOPES[activation](maps[i + 1])
            flat = gradient.reshape(-1, layers[i].channels)
            seen = gathered[i] if i < again else patches(maps[i], layers[i])
            columns = seen.reshape(-1, kernel.shape[0]).T
            found.append((matmul(columns, flat), jnp.sum(flat, axis=0)))
            if i or not pixels:
                back = matmul(flat, kernel.T).reshape(seen.shape)
                scatter = jax.linear_transpose(partial(patches, layer=layers[i]), maps[i])
                (gradient,) = scatter(back)
        return jax.tree.map(jnp.add, total, found[::-1]), None if pixels else gradient

    start = [(jnp.zeros_like(k.reshape(-1, k.shape[-1])), jnp.zeros_like(b)) for k, b in weights]
    parts = jax.tree.map(slices, (x, maps, gradients))
    back: Any
    total, back = lax.scan(step, start, parts)
    d_x: Any = np.zeros(x.shape, jax.dtypes.float0) if pixels else merge_slices(back)
    shaped = [(k.reshape(w.shape), b) for (k, b), (w, _) in zip(total, weights, strict=True)]
    return d_x, tuple(shaped)


conv_in_slices.defvjp(conv_in_slices_forward, conv_in_slices_backward)


def convolve_native(
    x: Array,
    weights: Weights,
    layers: Layers,
    activation: Activation,
    output_layers: tuple[int, ...],
) -> tuple[Array, ...]:
    """Apply XLA's own operation, layer by layer: the tests hold `convolve` to it.

    Args:
      x: images.
      weights: of each layer.
      layers: their sizes.
      activation: after each layer.
      output_layers: the layers whose maps are returned.
    """
    maps = []
    x = to_float(x).astype(weights[0][0].dtype)
    for (kernel, bias), layer in zip(weights, layers, strict=True):
        x = lax.conv_general_dilated(
            x,
            kernel,
            (layer.stride, layer.stride),
            ((layer.padding, layer.padding), (layer.padding, layer.padding)),
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
        )
        x = ACTIVATIONS[activation](x + bias[None, None, None, :])
        maps.append(x)
    return select_outputs(maps, output_layers)


def convolve(
    x: Shaped[Array, "B H W C"],
    weights: Weights,
    layers: Layers,
    activation: Activation,
    output_layers: tuple[int, ...],
) -> tuple[Float[Array, "B I J O"], ...]:
    """Apply convolutional layers, one after another: each activation(x * kernel + bias).

    `*` is the cross-correlation.

    Args:
      x: integer pixels (read as x / 255) or floats, channels last.
      weights: of each layer its kernel `[k, k, C, O]` and its bias `[O]`.
      layers: of each layer its channels O, its kernel side k, its stride and its padding.
      activation: a name in `ACTIVATIONS`.
      output_layers: the layers whose maps are returned, counted from 0.

    Returns:
      Their maps `[B, I, J, O]`, `I = (H + 2 * padding - k) // stride + 1`, `J` likewise.

    >>> layers = Convolution(5, stride=2), Convolution(7)
    >>> weights = (jnp.ones((3, 3, 1, 5)), jnp.zeros(5)), (jnp.ones((3, 3, 5, 7)), jnp.zeros(7))
    >>> [y.shape for y in convolve(jnp.ones((2, 4, 4, 1)), weights, layers, "relu", (0, 1))]
    [(2, 2, 2, 5), (2, 2, 2, 7)]
    """
    x = x if x.dtype == jnp.uint8 else to_float(x)  # uint8 is converted patch by patch
    count = x.shape[0]
    short = -count % slice_count(count)
    x = jnp.pad(x, ((0, short), (0, 0), (0, 0), (0, 0)))
    return tuple(y[:count] for y in conv_in_slices(x, weights, layers, activation, output_layers))
