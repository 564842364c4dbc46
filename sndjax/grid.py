"""The grid: any objective with any signal.

A cell is an objective with a signal. Its networks and reductions are those that the objective's
own published experiments ran; `sndjax/algorithm_table.py` names the cells of the thesis.
"""

from collections.abc import Callable, Mapping
from inspect import isfunction, signature
from types import ModuleType
from typing import Any, Literal, NamedTuple

from sndjax import objectives, signals
from sndjax.convolution import Convolution
from sndjax.intrinsic_module import IntrinsicModule
from sndjax.module import make_intrinsic_module
from sndjax.networks import ATARI, ROOT_2, Architecture, Encoder
from sndjax.preprocessing import Preprocess
from sndjax.protocols import Objective, Signal
from sndjax.signals.prediction import Gradient

# "elu" or "relu" throughout; "published": what the experiments ran, see `ObjectiveRecipe`.
Activation = Literal["elu", "relu", "published"]
# Fig. 5.4: three linear layers in the predictor and one in the target, or two identical networks
# with one linear layer, with two, or with one and ReLU.
Pairing = Literal["asymmetric", "one_linear", "two_linear", "relu"]


class ObjectiveRecipe(NamedTuple):
    """What an objective's published experiments put around it (the table of networks).

    Attributes:
      objective: makes the objective; None: the encoder stays random.
      convolutions: which ones the encoder has.
      encoder_gain: of the encoder's orthogonal weights.
      predictor_gain: of the predictor's.
      published: the activation after convolutions; between linear layers it is ELU.
      distillation: further arguments of the signals that have a predictor.
      wider_predictor: the predictor's last convolution has `last_predictor` channels.
    """

    objective: Callable[..., Objective] | None
    convolutions: Literal["strided", "rnd", "snd_v"] = "strided"
    encoder_gain: float = 0.5
    predictor_gain: float = ROOT_2
    published: Literal["elu", "relu"] = "relu"
    distillation: Mapping[str, Any] = {}
    wider_predictor: bool = True


def exported(package: ModuleType) -> dict[str, Callable[..., Any]]:
    """Return the constructors that a package exports, by name."""
    return {name: value for name, value in vars(package).items() if isfunction(value)}


PUBLISHED: dict[str, ObjectiveRecipe] = {
    "none": ObjectiveRecipe(
        None,
        convolutions="rnd",
        encoder_gain=ROOT_2,
        published="elu",
        distillation={"reward_reduction": "half_sum", "update_proportion": 0.25},
    ),
    "contrastive": ObjectiveRecipe(
        objectives.contrastive,
        convolutions="snd_v",
        encoder_gain=ROOT_2,
        published="elu",
        distillation={"update_proportion": 0.25},
    ),
    "st_dim": ObjectiveRecipe(
        objectives.st_dim,
        predictor_gain=0.5,
        distillation={"loss_reduction": "sum"},
        wider_predictor=False,
    ),
    "inverse_dynamics": ObjectiveRecipe(
        objectives.inverse_dynamics, encoder_gain=ROOT_2, wider_predictor=False
    ),
}
# Every objective there is; those without a recipe of their own are surrounded like VICReg.
OBJECTIVES = {
    name: ObjectiveRecipe(make) for name, make in exported(objectives).items()
} | PUBLISHED
SIGNALS: dict[str, Callable[..., Signal]] = exported(signals)


def make_signal(
    name: str,
    predictor: Encoder,
    distillation: Mapping[str, Any],
    gradient: Gradient,
    options: Mapping[str, Any] = {},
) -> Signal:
    """Make a signal with its options and those of the other arguments that its constructor takes.

    Args:
      name: a name in `SIGNALS`.
      predictor: the network that copies the encoder.
      distillation: how signals with a predictor reduce.
      gradient: of a forward loss into the encoder.
      options: further arguments of the constructor.

    Raises:
      ValueError: the constructor has no such option; those it has are named.
    """
    takes = signature(SIGNALS[name]).parameters
    given: dict[str, Any] = {}
    if "predictor" in takes:
        given |= {"predictor": predictor, **distillation}
    if "gradient" in takes:
        given["gradient"] = gradient
    if unknown := set(options) - set(takes):
        known = ", ".join(sorted(set(takes) - {"predictor"}))
        raise ValueError(f"signal {name} has no option {min(unknown)}; it has {known}")
    return SIGNALS[name](**{**given, **options})


def make_encoder_and_predictor(
    recipe: ObjectiveRecipe,
    size: Architecture,
    activation: Activation,
    pairing: Pairing,
    action_inputs: int = 0,
) -> tuple[Encoder, Encoder]:
    """Make the encoder and the predictor that learns to copy it (Fig. 5.3b-c, 5.4).

    For vectors the asymmetric pairing is the same multi-layer perceptron twice.

    Args:
      recipe: what the objective's experiments ran.
      size: the sizes of the networks.
      activation: "elu", "relu" or "published".
      pairing: of predictor and target.
      action_inputs: A where both take the action as input, else 0.
    """
    layers = {
        "strided": size.convolutions(size.last),
        "rnd": size.rnd_convolutions(),
        "snd_v": size.snd_v_convolutions(),
    }[recipe.convolutions]
    predictor_layers = layers
    if recipe.wider_predictor and recipe.convolutions == "strided" and pairing == "asymmetric":
        predictor_layers = size.convolutions(size.last_predictor)
    if pairing == "relu":
        activation = "relu"
    torso: Literal["elu", "relu"] = recipe.published if activation == "published" else activation
    between: Literal["elu", "relu"] = "relu" if activation == "relu" else "elu"
    extra = {"asymmetric": (0, 2), "two_linear": (1, 1)}.get(pairing, (0, 0))
    if not size.channels and pairing == "asymmetric":
        extra = (0, 0)

    def encoder(layers: tuple[Convolution, ...], gain: float, extra: int) -> Encoder:
        return Encoder(
            layers, size.hidden, size.features, gain, extra, torso, between, action_inputs
        )

    return (
        encoder(layers, recipe.encoder_gain, extra[0]),
        encoder(predictor_layers, recipe.predictor_gain, extra[1]),
    )


def make_module_from_recipe(
    recipe: ObjectiveRecipe,
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
    objective_options: Mapping[str, Any] = {},
    signal_options: Mapping[str, Any] = {},
) -> IntrinsicModule:
    """Make the module of a recipe and a signal; as `make_module`, for an objective of one's own.

    Args:
      recipe: the objective and what surrounds it.
      signal: a name in `SIGNALS`.
      num_actions: A.
      size: the sizes of the networks.
      preprocess: what frames go through first: "none", "mean" or "standardize" (5.2.2).
      activation: "elu", "relu" or "published".
      pairing: of predictor and target (Fig. 5.4), where there is a predictor.
      gradient: of the forward loss into the encoder, where there is one.
      action_input: the encoder and the predictor take the action as input.
      weights: of the objective's and of the signal's loss.
      objective_options: arguments of the objective's constructor.
      signal_options: arguments of the signal's constructor.

    Raises:
      ValueError: `action_input`, and this is not distillation without an objective (QRND); or the
        signal has no such option.
    """
    if action_input and (recipe.objective is not None or signal != "distillation"):
        raise ValueError("action_input is for the signal 'distillation' without an objective")
    encoder, predictor = make_encoder_and_predictor(
        recipe, size, activation, pairing, num_actions if action_input else 0
    )
    return make_intrinsic_module(
        encoder,
        recipe.objective(**objective_options) if recipe.objective else None,
        make_signal(signal, predictor, recipe.distillation, gradient, signal_options),
        num_actions,
        preprocess=preprocess,
        weights=weights,
    )


def make_module(
    objective: str, signal: str, num_actions: int, size: Architecture = ATARI, **options: Any
) -> IntrinsicModule:
    """Make any cell of the grid, by the names of its objective and its signal.

    `rnd`, `icm` and `sp` add settings of their own to theirs, see `sndjax.algorithm_table`.

    Args:
      objective: a name in `OBJECTIVES`; "none" is a random encoder that stays as it is.
      signal: a name in `SIGNALS`.
      num_actions: A.
      size: the sizes of the networks.
      **options: of every cell, see `make_module_from_recipe`.

    Raises:
      ValueError: there is no such objective or signal; the known ones are named.

    >>> from sndjax import VECTOR
    >>> make_module("inverse_dynamics", "re3", 3, VECTOR)  # doctest: +ELLIPSIS
    IntrinsicModule(objective=inverse_dynamics(last=1.0), signal=re3(k=4, average=True, ...
    """
    for what, name, known in (("objective", objective, OBJECTIVES), ("signal", signal, SIGNALS)):
        if name not in known:
            raise ValueError(f"unknown {what} '{name}'; there is {', '.join(known)}")
    return make_module_from_recipe(OBJECTIVES[objective], signal, num_actions, size, **options)
