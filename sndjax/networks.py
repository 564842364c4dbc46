"""The networks of the thesis (Fig. 5.3): encoders and the actor-critic.

Weights are orthogonal with the gains of the published experiments, biases zero.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Float, Int, PRNGKeyArray, Shaped

from sndjax.checks import SIDE, check_images
from sndjax.convolution import ACTIVATIONS, Activation, Convolution, convolve, to_float
from sndjax.types import Params

ROOT_2 = math.sqrt(2.0)


class Architecture(NamedTuple):
    """The sizes of every network for one kind of input: a column of the network table.

    With no `channels` the networks are multi-layer perceptrons of two `hidden` layers.
    """

    channels: tuple[int, ...] = (32, 64, 64)  # the three strided convolutions
    last: int = 128  # the fourth, of the policy's torso and of targets
    last_predictor: int = 128  # the fourth, of predictors of a VICReg target
    rnd_channels: tuple[int, ...] = (32, 64, 64)
    snd_v_channels: tuple[int, ...] = (16, 32, 64)
    features: int = 512  # d, and the width of every linear layer
    hidden: tuple[int, ...] = (64, 64)
    patch: int = 0  # kernel side and stride of the first layer; 0: the thesis' 3x3, stride 2

    def convolutions(self, last: int) -> tuple[Convolution, ...]:
        """Return the convolutions of the thesis: three of stride 2, then one of stride 1.

        Args:
          last: channels of the fourth.
        """
        if not self.channels:
            return ()
        layers = [Convolution(c, stride=2) for c in self.channels]
        if self.patch:
            layers[0] = Convolution(self.channels[0], self.patch, self.patch, padding=0)
        return (*layers, Convolution(last))

    def snd_v_convolutions(self) -> tuple[Convolution, ...]:
        """Return SND-V's convolutions: fewer channels, and the last as many as the third."""
        narrow = self._replace(channels=self.snd_v_channels if self.channels else ())
        return narrow.convolutions(self.snd_v_channels[-1])

    def rnd_convolutions(self) -> tuple[Convolution, ...]:
        """Return the convolutions of RND; with a patch layer, those of the other networks."""
        if self.patch or not self.channels:
            return self.convolutions(self.last)
        first, second, third = self.rnd_channels
        return (Convolution(first, 8, 4, 2), Convolution(second, stride=2), Convolution(third))


ATARI = Architecture()
PROCGEN = Architecture(last=64)
# Ours, for two cores: 64x64 pixels become 16x16, 8x8 and 4x4 maps of a few channels.
SMALL = Architecture(
    channels=(16, 32, 32),
    last=32,
    last_predictor=32,
    snd_v_channels=(16, 32, 32),
    features=128,
    patch=4,
)
VECTOR = Architecture(channels=(), features=64)


def size_for(shape: tuple[int, ...], small: bool = False) -> Architecture:
    """Return the sizes of networks for frames of a shape.

    Images [H, W, C] of 32x32 and more get convolutions: the thesis' for Procgen where C = 3, those
    for Atari elsewhere. Everything else is a vector.

    Args:
      shape: of a frame.
      small: images get our networks for a few cores.

    >>> size_for((4,)) == size_for((10, 10, 4)) == VECTOR, size_for((84, 84, 4)) == ATARI
    (True, True)
    """
    if len(shape) != 3 or min(shape[:2]) < SIDE:
        return VECTOR
    return SMALL if small else PROCGEN if shape[-1] == 3 else ATARI


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
    return nn.Dense(features, kernel_init=orthogonal(gain), name=name)


class Torso(nn.Module):
    """Convolutions (pixels) or hidden layers (vectors), each with its activation.

    Returns the flattened output and the third layer's map (the last hidden layer's,
    `[B, 1, 1, C]`, for vectors).
    """

    convolutions: Sequence[Convolution]
    hidden: Sequence[int]
    gain: float
    activation: Activation

    @nn.compact
    def __call__(self, x: Shaped[Array, "B *frame"]) -> tuple[Float[Array, "B f"], Array]:
        if not self.convolutions:
            x = to_float(x).reshape(x.shape[0], -1)
            for width in self.hidden:
                x = ACTIVATIONS[self.activation](linear(width, self.gain)(x))
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

    @property
    def description(self) -> str:
        """Return its settings that differ between modules, for the `repr` of a module."""
        text = f"activation={self.activation!r}, extra_activation={self.extra_activation!r}"
        return text + (", action_input=True" if self.num_actions else "")

    @nn.compact
    def __call__(
        self, frames: Shaped[Array, "B *frame"], action: Int[Array, " B"] | None = None
    ) -> tuple[Float[Array, "B d"], Float[Array, "B I J C"]]:
        x, local = Torso(self.convolutions, self.hidden, self.gain, self.activation)(frames)
        if self.num_actions:
            assert action is not None, "this encoder takes the action as input"
            x = jnp.concatenate([x, jax.nn.one_hot(action, self.num_actions, dtype=x.dtype)], -1)
        z = linear(self.features, self.gain)(x)
        for _ in range(self.extra):
            z = linear(self.features, self.gain)(ACTIVATIONS[self.extra_activation](z))
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


class ActorCritic(nn.Module):
    """The policy and its value heads on one torso (Fig. 5.3a).

    Maps stacked frames `[B, H, W, C * S]` (or vectors `[B, D]`) to
    `(logits float32[B, A], value float32[B, K])`. With one head (the baseline) the
    critic stands behind an extra ReLU, as in the published experiments. The torso's features are
    sown as the intermediate "torso", see `torso_features`.
    """

    architecture: Architecture
    num_actions: int
    value_heads: int = 2

    @nn.compact
    def __call__(
        self, stacked: Shaped[Array, "B *stack"]
    ) -> tuple[Float[Array, "B A"], Float[Array, "B K"]]:
        size = self.architecture
        x, _ = Torso(size.convolutions(size.last), size.hidden, ROOT_2, "relu")(stacked)
        x = linear(size.features, ROOT_2)(x)
        self.sow("intermediates", "torso", x)
        actor = jax.nn.relu(linear(size.features, 0.01)(jax.nn.relu(x)))
        logits = linear(self.num_actions, 0.01)(actor)
        critic = jax.nn.relu(x) if self.value_heads == 1 else x
        critic = jax.nn.relu(linear(size.features, 0.1)(critic))
        heads = [linear(1, 0.01)(critic) for _ in range(self.value_heads)]
        return logits, jnp.concatenate(heads, axis=-1)


def torso_features(
    network: ActorCritic, params: Params, stacked: Shaped[Array, "B *stack"]
) -> Float[Array, "B d"]:
    """Return what the policy's torso makes of stacks: the output of its linear layer.

    Args:
      network: the policy.
      params: its weights.
      stacked: frames of a stack on the last axis.
    """
    _, found = network.apply(params, stacked, mutable=["intermediates"])
    return found["intermediates"]["torso"][0]
