"""The networks of the thesis (Fig. 5.3): encoders and the actor-critic.

Weights are orthogonal with the gains of the published experiments, biases zero.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Shaped

from sndjax.convolution import ACTIVATIONS, Activation, Convolution, convolve, to_float

ROOT_2 = math.sqrt(2.0)


class Architecture(NamedTuple):
    """The sizes of every network for one kind of input: a column of the network table.

    With no `channels` the networks are multi-layer perceptrons of two `hidden` layers.
    """

    channels: tuple[int, ...] = (32, 64, 64)  # the three strided convolutions
    last: int = 128  # the fourth, of the policy's torso and of targets
    last_learned: int = 128  # the fourth, of learned networks on a VICReg target
    rnd_channels: tuple[int, ...] = (32, 64, 64)
    snd_v_channels: tuple[int, ...] = (16, 32, 64)
    features: int = 512  # d, and the width of every linear layer
    hidden: tuple[int, ...] = (64, 64)
    patch: int = 0  # kernel side and stride of the first layer; 0: the thesis' 3x3, stride 2

    def convolutions(self, last: int) -> tuple[Convolution, ...]:
        """The convolutions of the thesis: three of stride 2, then one of stride 1."""
        if not self.channels:
            return ()
        layers = [Convolution(c, stride=2) for c in self.channels]
        if self.patch:
            layers[0] = Convolution(self.channels[0], self.patch, self.patch, padding=0)
        return (*layers, Convolution(last))

    def snd_v_convolutions(self) -> tuple[Convolution, ...]:
        """SND-V's: as `convolutions` with fewer channels, and the last as many as the third."""
        narrow = self._replace(channels=self.snd_v_channels if self.channels else ())
        return narrow.convolutions(self.snd_v_channels[-1])

    def rnd_convolutions(self) -> tuple[Convolution, ...]:
        """The convolutions of Random Network Distillation; in patches, those of the others."""
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
    last_learned=32,
    snd_v_channels=(16, 32, 32),
    features=128,
    patch=4,
)
VECTOR = Architecture(channels=(), features=64)


def linear(features: int, gain: float) -> nn.Dense:
    """A linear layer with orthogonal weights of the given gain and zero biases."""
    return nn.Dense(features, kernel_init=nn.initializers.orthogonal(gain))


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
        weights, channels = [], x.shape[-1]
        for i, layer in enumerate(self.convolutions):
            shape = (layer.size, layer.size, channels, layer.channels)
            kernel = self.param(f"kernel_{i}", nn.initializers.orthogonal(self.gain), shape)
            bias = self.param(f"bias_{i}", nn.initializers.zeros, (layer.channels,))
            weights.append((kernel, bias))
            channels = layer.channels
        layers = tuple(self.convolutions)
        wanted = (min(2, len(layers) - 1), len(layers) - 1)
        local, last = convolve(x, tuple(weights), layers, self.activation, wanted)
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

    @nn.compact
    def __call__(
        self, frames: Shaped[Array, "B *frame"], action: Int[Array, " B"] | None = None
    ) -> tuple[Float[Array, "B d"], Float[Array, "B I J C"]]:
        x, local = Torso(self.convolutions, self.hidden, self.gain, self.activation)(frames)
        if self.num_actions:
            assert action is not None, "this encoder takes the action in"
            x = jnp.concatenate([x, jax.nn.one_hot(action, self.num_actions, dtype=x.dtype)], -1)
        z = linear(self.features, self.gain)(x)
        for _ in range(self.extra):
            z = linear(self.features, self.gain)(ACTIVATIONS[self.extra_activation](z))
        return z, local


class Perceptron(nn.Module):
    """Linear layers of the given widths, gain sqrt(2), with a ReLU between them.

    The forward model, the inverse model and BYOL's heads: `[B, n]` to `[B, widths[-1]]`.
    """

    widths: Sequence[int]

    @nn.compact
    def __call__(self, x: Float[Array, "B n"]) -> Float[Array, "B m"]:
        for width in self.widths[:-1]:
            x = jax.nn.relu(linear(width, ROOT_2)(x))
        return linear(self.widths[-1], ROOT_2)(x)


class ActorCritic(nn.Module):
    """The policy and its value heads on one torso (Fig. 5.3a).

    Maps stacked frames `[B, H, W, C * S]` (or vectors `[B, D]`) to
    `(logits float32[B, A], value float32[B, K])`. With one head (the baseline) the
    critic stands behind an extra ReLU, as in the published experiments.
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
        actor = jax.nn.relu(linear(size.features, 0.01)(jax.nn.relu(x)))
        logits = linear(self.num_actions, 0.01)(actor)
        critic = jax.nn.relu(x) if self.value_heads == 1 else x
        critic = jax.nn.relu(linear(size.features, 0.1)(critic))
        heads = [linear(1, 0.01)(critic) for _ in range(self.value_heads)]
        return logits, jnp.concatenate(heads, axis=-1)
