"""The sizes of networks: of the thesis, of our smaller and larger ones."""

from typing import Literal, NamedTuple

from sndjax.activations import Activation
from sndjax.checks import SIDE, check_choice
from sndjax.convolution import Convolution

Memory = Literal["none", "gru"]


class Architecture(NamedTuple):
    """The sizes of every network for one kind of input: a column of the network table.

    With no `channels` the networks are multi-layer perceptrons of the `hidden` layers.
    """

    channels: tuple[int, ...] = (32, 64, 64)  # the three strided convolutions
    last: int = 128  # the fourth, of the policy's torso and of targets
    last_predictor: int = 128  # the fourth, of predictors of a VICReg target
    rnd_channels: tuple[int, ...] = (32, 64, 64)
    snd_v_channels: tuple[int, ...] = (16, 32, 64)
    features: int = 512  # d, and the width of every linear layer
    hidden: tuple[int, ...] = (64, 64)
    patch: int = 0  # kernel side and stride of the first layer; 0: the thesis' 3x3, stride 2
    activation: Activation = "relu"  # of the policy; `make_module` has that of modules
    layer_norm: bool = False  # before the activations of hidden and linear layers
    memory: Memory = "none"  # of the policy, between its torso and its heads; of modules none

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
        first, *others = self.rnd_channels
        strided = (Convolution(channels, stride=2) for channels in others[:-1])
        return (Convolution(first, 8, 4, 2), *strided, *map(Convolution, others[-1:]))


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
FLAT = Architecture(channels=(), hidden=(256, 256), features=256)  # images without convolutions
WIDE = Architecture(
    channels=(64, 128, 128),
    last=256,
    last_predictor=256,
    rnd_channels=(64, 128, 128),
    snd_v_channels=(32, 64, 128),
    features=1024,
)


class NamedNetwork(NamedTuple):
    """The sizes of a named network for each kind of input."""

    gray: Architecture  # images of another number of channels than 3
    colour: Architecture  # images of 3 channels
    vector: Architecture


NETWORKS = {
    "thesis": NamedNetwork(ATARI, PROCGEN, VECTOR),
    "small": NamedNetwork(SMALL, SMALL, VECTOR),
    "mlp": NamedNetwork(FLAT, FLAT, VECTOR),
    "wide": NamedNetwork(
        gray=WIDE,
        colour=WIDE._replace(last=128),
        vector=VECTOR._replace(hidden=(512, 512), features=512),
    ),
}


def size_for(shape: tuple[int, ...], network: str = "thesis") -> Architecture:
    """Return the sizes of networks for frames of a shape.

    Images [H, W, C] of 32x32 and more get convolutions: the thesis' for Procgen where C = 3, those
    for Atari elsewhere. Everything else is a vector.

    Args:
      shape: of a frame.
      network: a name in `NETWORKS`.

    Raises:
      ValueError: there is no such network; those there are are named.

    >>> size_for((4,)) == size_for((10, 10, 4)) == VECTOR, size_for((84, 84, 4)) == ATARI
    (True, True)
    """
    check_choice("network", network, tuple(NETWORKS))
    named = NETWORKS[network]
    if len(shape) != 3 or min(shape[:2]) < SIDE:
        return named.vector
    return named.colour if shape[-1] == 3 else named.gray
