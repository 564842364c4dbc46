"""The grid: any objective with any signal.

A cell's networks and reductions are those that the objective's own published experiments
ran; `sndjax/algorithms.py` names the cells of the thesis.
"""

from collections.abc import Callable
from functools import partial
from inspect import isfunction
from types import ModuleType
from typing import Any, Literal, NamedTuple

from sndjax import objectives, signals
from sndjax.module import compose
from sndjax.networks import ATARI, ROOT_2, Architecture, Encoder
from sndjax.preprocessing import Preprocess
from sndjax.signals.prediction import Gradient
from sndjax.types import IntrinsicModule, Objective, Signal

# "elu" or "relu" throughout; "published": what the experiments ran, see `Recipe`.
Activation = Literal["elu", "relu", "published"]
# Fig. 5.4: three linear layers in the learned network and one in the target, or two
# identical networks with one linear layer, with two, or with one and ReLU.
Pairing = Literal["asymmetric", "one_linear", "two_linear", "relu"]


class Recipe(NamedTuple):
    """What an objective's published experiments put around it (the table of networks)."""

    objective: Callable[[], Objective] | None
    convolutions: Literal["strided", "rnd", "snd_v"] = "strided"
    gain: float = 0.5  # of the encoder
    learned_gain: float = ROOT_2
    published: Literal["elu", "relu"] = "relu"  # after convolutions; linear layers are ELU
    distillation: dict[str, Any] = {}  # noqa: RUF012 - read only
    wider: bool = True  # the learned network's last convolution is `last_learned`


def exported(package: ModuleType) -> dict[str, Callable[..., Any]]:
    """The constructors that a package exports, by name."""
    return {name: value for name, value in vars(package).items() if isfunction(value)}


def plain(make: Callable[[], Signal], learned: Encoder, how: dict[str, Any], gradient: Gradient):
    """A signal that needs none of what surrounds it."""
    return make()


PUBLISHED: dict[str, Recipe] = {
    "none": Recipe(None, "rnd", ROOT_2, ROOT_2, "elu", {"reading": "half_sum", "keep": 0.25}),
    "contrastive": Recipe(objectives.contrastive, "snd_v", ROOT_2, ROOT_2, "elu", {"keep": 0.25}),
    "st_dim": Recipe(
        objectives.st_dim, learned_gain=0.5, distillation={"reduction": "sum"}, wider=False
    ),
    "inverse_dynamics": Recipe(objectives.inverse_dynamics, gain=ROOT_2, wider=False),
}
# Every objective there is; those without a recipe of their own are surrounded like VICReg.
OBJECTIVES = {name: Recipe(make) for name, make in exported(objectives).items()} | PUBLISHED
# What reads the signal off an encoder, given the network that copies it and its reductions.
SIGNALS: dict[str, Callable[[Encoder, dict[str, Any], Gradient], Signal]] = {
    name: partial(plain, make) for name, make in exported(signals).items()
} | {
    "distillation": lambda learned, how, gradient: signals.distillation(learned, **how),
    "noveld": lambda learned, how, gradient: signals.noveld(learned, **how),
    "ngu": lambda learned, how, gradient: signals.ngu(learned, **how),
    "prediction": lambda learned, how, gradient: signals.prediction(gradient=gradient),
}
COPYING = ("distillation", "noveld", "ngu")  # signals with a learned network


def networks(
    recipe: Recipe,
    size: Architecture,
    activation: Activation,
    pairing: Pairing,
    action_inputs: int = 0,
) -> tuple[Encoder, Encoder]:
    """The encoder and the network that learns to copy it (Fig. 5.3b-c, 5.4).

    For vectors the asymmetric pairing is the same multi-layer perceptron twice.
    """
    layers = {
        "strided": size.convolutions(size.last),
        "rnd": size.rnd_convolutions(),
        "snd_v": size.snd_v_convolutions(),
    }[recipe.convolutions]
    learned_layers = layers
    if recipe.wider and recipe.convolutions == "strided" and pairing == "asymmetric":
        learned_layers = size.convolutions(size.last_learned)
    if pairing == "relu":
        activation = "relu"
    torso: Literal["elu", "relu"] = recipe.published if activation == "published" else activation
    between: Literal["elu", "relu"] = "relu" if activation == "relu" else "elu"
    extra = {"asymmetric": (0, 2), "two_linear": (1, 1)}.get(pairing, (0, 0))
    if not size.channels and pairing == "asymmetric":
        extra = (0, 0)

    def encoder(layers, gain, extra):
        return Encoder(
            layers, size.hidden, size.features, gain, extra, torso, between, action_inputs
        )

    return (
        encoder(layers, recipe.gain, extra[0]),
        encoder(learned_layers, recipe.learned_gain, extra[1]),
    )


def cell(
    recipe: Recipe,
    signal: str,
    num_actions: int,
    size: Architecture = ATARI,
    *,
    preprocess: Preprocess = "none",
    activation: Activation = "elu",
    pairing: Pairing = "asymmetric",
    gradient: Gradient = "symmetric",
    action_input: bool = False,
    weights: tuple[float, float] = (1.0, 1.0),
) -> IntrinsicModule:
    """The module of a recipe and a signal; `grid` with the objective's surroundings open.

    Args:
      recipe: the objective and what surrounds it.
      signal: a name in `SIGNALS`.
      num_actions: A.
      size: the sizes of the networks.
      preprocess, activation, pairing, gradient: see `grid`.
      action_input: the encoder and the network that copies it take the action in.
      weights: of the objective's and of the signal's loss.

    Raises:
      ValueError: only distillation without an objective reads an action (QRND).
    """
    if action_input and (recipe.objective is not None or signal != "distillation"):
        raise ValueError("action_input is for the signal 'distillation' without an objective")
    encoder, learned = networks(
        recipe, size, activation, pairing, num_actions if action_input else 0
    )
    return compose(
        encoder,
        recipe.objective() if recipe.objective else None,
        SIGNALS[signal](learned, recipe.distillation, gradient),
        num_actions,
        preprocess=preprocess,
        weights=weights,
    )


def grid(
    objective: str, signal: str, num_actions: int, size: Architecture = ATARI, **options: Any
) -> IntrinsicModule:
    """Any cell of the grid, by the names of its objective and its signal.

    `rnd`, `icm` and `sp` add settings of their own to theirs, see `sndjax.algorithms`.

    Args:
      objective: a name in `OBJECTIVES`; "none" is a random encoder that stays as it is.
      signal: a name in `SIGNALS`.
      num_actions: A.
      size: the sizes of the networks.
      **options: of every cell. `preprocess`: "none", "mean" or "standardize" (5.2.2).
        `activation`: "elu", "relu" or "published". `pairing`: of learned network and target
        (Fig. 5.4), where there is a learned network. `gradient`: of the forward loss into
        the encoder, where the signal is "prediction".

    Raises:
      ValueError: there is no such objective or signal; the known ones are named.

    >>> from sndjax import VECTOR
    >>> grid("barlow_twins", "noveld", 3, VECTOR)  # doctest: +ELLIPSIS
    IntrinsicModule(init=...)
    """
    for what, name, known in (("objective", objective, OBJECTIVES), ("signal", signal, SIGNALS)):
        if name not in known:
            raise ValueError(f"unknown {what} '{name}'; there is {', '.join(known)}")
    return cell(OBJECTIVES[objective], signal, num_actions, size, **options)
