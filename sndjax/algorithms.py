"""The named algorithms: every method of the thesis is one cell, objective x signal.

| name      | objective of the target      | signal                       |
|-----------|------------------------------|------------------------------|
| `rnd`     | none, a frozen random target | distillation                 |
| `snd_std` | ST-DIM, regularised (5.6)    | distillation                 |
| `snd_vic` | VICReg (5.7)                 | distillation                 |

Each takes the number of actions and an `Architecture`, and gives an `IntrinsicModule`.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

from sndjax.networks import ATARI, ROOT_2, Architecture, Convolution, Encoder
from sndjax.objectives.st_dim import st_dim
from sndjax.objectives.vicreg import vicreg
from sndjax.preprocessing import Preprocess
from sndjax.signals.distillation import distillation
from sndjax.types import IntrinsicModule

# "elu" throughout, as the thesis says motivation models work best; or as published,
# where convolutions are ReLU and only the learned network's linear layers ELU.
Activation = Literal["elu", "published"]


class Pair(NamedTuple):
    """A target and a learned network."""

    target: Encoder
    learned: Encoder


def pair(
    size: Architecture,
    convolutions: tuple[tuple[Convolution, ...], tuple[Convolution, ...]],
    gains: tuple[float, float],
    activation: Literal["elu", "relu"],
) -> Pair:
    """Target and learned network; the learned one has two more linear layers (Fig. 5.3b-c).

    For vectors both are the same multi-layer perceptron.
    """
    extra = 2 if size.channels else 0
    return Pair(
        Encoder(convolutions[0], size.hidden, size.features, gains[0], 0, activation),
        Encoder(convolutions[1], size.hidden, size.features, gains[1], extra, activation),
    )


def rnd(
    num_actions: int,
    size: Architecture = ATARI,
    *,
    preprocess: Preprocess = "mean",
    activation: Activation = "elu",
) -> IntrinsicModule:
    """Random network distillation (section 4.1.2; Burda et al., 2018).

    The published networks are ELU throughout, so that both activations are the same one.

    >>> import jax, jax.numpy as jnp
    >>> params, state = rnd(18).init(jax.random.key(0), jnp.zeros((1, 96, 96, 1), jnp.uint8))
    >>> sorted(params), sorted(state)
    (['learned'], ['moments', 'target'])
    """
    layers = size.rnd_convolutions()
    target, learned = pair(size, (layers, layers), (ROOT_2, ROOT_2), "elu")
    return distillation(
        target,
        learned,
        None,
        num_actions,
        signal="half_sum",
        keep=0.25,
        preprocess=preprocess,
    )


def snd_std(
    num_actions: int,
    size: Architecture = ATARI,
    *,
    preprocess: Preprocess = "none",
    activation: Activation = "elu",
) -> IntrinsicModule:
    """SND with ST-DIM, logit-norm and feature-spread regularised (section 5.1.1, eq. 5.6).

    >>> snd_std(18)  # doctest: +ELLIPSIS
    IntrinsicModule(init=...)
    """
    layers = size.convolutions(size.last)
    target, learned = pair(size, (layers, layers), (0.5, 0.5), torso_activation(activation))
    return distillation(
        target, learned, st_dim(), num_actions, reduction="sum", preprocess=preprocess
    )


def snd_vic(
    num_actions: int,
    size: Architecture = ATARI,
    *,
    preprocess: Preprocess = "none",
    activation: Activation = "elu",
) -> IntrinsicModule:
    """SND with VICReg on consecutive states (section 5.1.2, eq. 5.7).

    >>> import jax, jax.numpy as jnp
    >>> from sndjax import VECTOR
    >>> params, _ = snd_vic(3, VECTOR).init(jax.random.key(0), jnp.zeros((1, 2)))
    >>> sorted(params)
    ['learned', 'objective', 'target']
    """
    target, learned = pair(
        size,
        (size.convolutions(size.last), size.convolutions(size.last_learned)),
        (0.5, ROOT_2),
        torso_activation(activation),
    )
    return distillation(target, learned, vicreg(), num_actions, preprocess=preprocess)


def torso_activation(activation: Activation) -> Literal["elu", "relu"]:
    """The activation of the convolutions of STD and VIC; their linear layers are ELU."""
    return "elu" if activation == "elu" else "relu"


NAMED: dict[str, Callable[..., IntrinsicModule] | None] = {
    "ppo": None,  # the baseline has no module
    "rnd": rnd,
    "snd_std": snd_std,
    "snd_vic": snd_vic,
}
