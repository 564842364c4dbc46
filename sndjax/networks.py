"""The layers and encoders of the thesis' networks (Fig. 5.3).

Weights are orthogonal with the gains of the published experiments, biases zero.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Float, Int, PRNGKeyArray, Shaped

from sndjax.activations import ACTIVATIONS, Activation
from sndjax.checks import check_images
from sndjax.convolution import Convolution, convolve, to_float
from sndjax.products import dot_general
from sndjax.types import Params

ROOT_2 = math.sqrt(2.0)


def match_dtype(tree: Any, params: Params) -> Any:
    """Convert the floating-point numbers of a tree to the dtype of a network's weights.

    With JAX_ENABLE_X64=1 a caller's arrays are often float64, and the weights float32.
    """
    (dtype, *_) = (leaf.dtype for leaf in jax.tree.leaves(params))
    floating = lambda x: jnp.issubdtype(x.dtype, jnp.floating)
    return jax.tree.map(lambda x: x.astype(dtype) if floating(x) else x, tree)


def orthogonal(gain: float) -> Callable[..., Float[Array, "*shape"]]:
    """Return flax's orthogonal initializer, which under `jax.vmap` factorizes one by one.

    Batched QR factorizations of jaxlib 0.10 wait for each other for ever on a CPU of two cores.

    Args:
      gain: of the weights.

    >>> draw = lambda key: orthogonal(1.0)(key, (2, 2), jnp.float32)
    >>> jax.vmap(draw)(jax.random.split(jax.random.key(0), 3)).shape
    (3, 2, 2)
    """

    def init(
        key: PRNGKeyArray, shape: Sequence[int], dtype: Any = jnp.float32
    ) -> Float[Array, "*shape"]:
        draw = nn.initializers.orthogonal(gain)
        return sequential_vmap(lambda key: draw(key, tuple(shape), dtype))(key)

    return init


def linear(features: int, gain: float, name: str | None = None) -> nn.Dense:
    """Make a linear layer with orthogonal weights and zero biases.

    Args:
      features: outputs.
      gain: of the orthogonal weights.
      name: of its weights, where something reads them by name.
    """
    return nn.Dense(features, kernel_init=orthogonal(gain), dot_general=dot_general, name=name)


def normalize(x: Float[Array, "B n"], layer_norm: bool) -> Float[Array, "B n"]:
    """Return the output of a linear layer, with layer normalisation if there is any."""
    return nn.LayerNorm()(x) if layer_norm else x


class Torso(nn.Module):
    """Convolutions (pixels) or hidden layers (vectors), each with its activation.

    Layer normalisation is that of hidden layers; convolutions have none.

    Returns the flattened output and the third layer's map (the last hidden layer's,
    `[B, 1, 1, C]`, for vectors).
    """

    convolutions: Sequence[Convolution]
    hidden: Sequence[int]
    gain: float
    activation: Activation
    layer_norm: bool = False

    @nn.compact
    def __call__(self, x: Shaped[Array, "B *frame"]) -> tuple[Float[Array, "B f"], Array]:
        if not self.convolutions:
            x = to_float(x).reshape(x.shape[0], -1)
            for width in self.hidden:
                x = normalize(linear(width, self.gain)(x), self.layer_norm)
                x = ACTIVATIONS[self.activation](x)
            return x, x[:, None, None, :]
        check_images(x)
        weights, channels = [], x.shape[-1]
        for i, layer in enumerate(self.convolutions):
            shape = (layer.size, layer.size, channels, layer.channels)
            zeros = nn.initializers.zeros
            kernel = self.param(f"kernel_{i}", orthogonal(self.gain), shape, jnp.float32)
            bias = self.param(f"bias_{i}", zeros, (layer.channels,), jnp.float32)
            weights.append((kernel, bias))
            channels = layer.channels
        layers = tuple(self.convolutions)
        outputs = (min(2, len(layers) - 1), len(layers) - 1)
        local, last = convolve(x, tuple(weights), layers, self.activation, outputs)
        return last.reshape(last.shape[0], -1), local


class Encoder(nn.Module):
    """A torso, a linear layer to d features, and `extra` further ones.

    Maps frames `[B, *frame]` to `(z float32[B, d], local float32[B, I, J, C])`. With
    `num_actions` an action `[B]` is part of the input: one-hot, it joins the flattened
    features before the first linear layer.
    """

    convolutions: Sequence[Convolution]
    hidden: Sequence[int]
    features: int
    gain: float
    extra: int = 0
    activation: Activation = "elu"  # after convolutions and hidden layers
    extra_activation: Activation = "elu"  # between the linear layers
    num_actions: int = 0
    layer_norm: bool = False  # before every activation but those of convolutions

    @property
    def description(self) -> str:
        """Return its settings that differ between modules, for the `repr` of a module."""
        text = f"activation={self.activation!r}, extra_activation={self.extra_activation!r}"
        return text + (", action_input=True" if self.num_actions else "")

    @nn.compact
    def __call__(
        self, frames: Shaped[Array, "B *frame"], action: Int[Array, " B"] | None = None
    ) -> tuple[Float[Array, "B d"], Float[Array, "B I J C"]]:
        x, local = Torso(
            self.convolutions, self.hidden, self.gain, self.activation, self.layer_norm
        )(frames)
        if self.num_actions:
            assert action is not None, "this encoder takes the action as input"
            x = jnp.concatenate([x, jax.nn.one_hot(action, self.num_actions, dtype=x.dtype)], -1)
        z = linear(self.features, self.gain)(x)
        for _ in range(self.extra):
            z = ACTIVATIONS[self.extra_activation](normalize(z, self.layer_norm))
            z = linear(self.features, self.gain)(z)
        return z, local


class MLP(nn.Module):
    """Linear layers of the given widths, gain sqrt(2), with a ReLU between them.

    The forward model, the inverse model and BYOL's heads: `[B, n]` to `[B, widths[-1]]`.
    """

    widths: Sequence[int]

    @nn.compact
    def __call__(self, x: Float[Array, "B n"]) -> Float[Array, "B m"]:
        *hidden, last = self.widths
        for i, width in enumerate(hidden):
            x = jax.nn.relu(linear(width, ROOT_2, mlp_layer(i))(x))
        return linear(last, ROOT_2, mlp_layer(len(hidden)))(x)


def mlp_layer(i: int) -> str:
    """Return the name of layer i of an `MLP`, which is part of its weights' paths."""
    return f"Dense_{i}"


def mlp_widths(params: Params) -> tuple[int, ...]:
    """Return the widths of an `MLP` from its weights: its inputs, and each layer's outputs.

    >>> mlp_widths(MLP((5, 3)).init(jax.random.key(0), jnp.zeros((1, 2))))
    (2, 5, 3)
    """
    layers = params["params"]
    kernels = [layers[mlp_layer(i)]["kernel"] for i in range(len(layers))]
    return (kernels[0].shape[-2], *(kernel.shape[-1] for kernel in kernels))
