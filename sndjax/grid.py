"""The grid: any objective with any signal.

A cell is an objective with a signal. Its networks and reductions are those that the objective's
own published experiments ran; `sndjax/algorithm_table.py` names the cells of the thesis.
"""

from collections.abc import Callable, Mapping
from inspect import isfunction, signature
from types import ModuleType
from typing import Any, Literal, NamedTuple, TypeVar, get_args

from sndjax import objectives, signals
from sndjax.activations import Activation
from sndjax.algorithm_table import DISTILLATION
from sndjax.architectures import ATARI, Architecture
from sndjax.checks import check_choice
from sndjax.convolution import Convolution
from sndjax.intrinsic_module import IntrinsicModule
from sndjax.module import make_intrinsic_module
from sndjax.networks import ROOT_2, Encoder
from sndjax.preprocessing import Preprocess
from sndjax.protocols import Objective, Signal

# One throughout, or "published": what the experiments ran, see `ObjectiveRecipe`.
ModuleActivation = Literal["elu", "relu", "leaky_relu", "tanh", "published"]
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


AnyObjective = str | Objective | ObjectiveRecipe | Callable[..., Objective]
AnySignal = str | Signal | Callable[..., Signal]
T = TypeVar("T")


def exported(package: ModuleType) -> dict[str, Callable[..., Any]]:
    """Return the constructors that a package exports, by name."""
    return {name: value for name, value in vars(package).items() if isfunction(value)}


PUBLISHED: dict[str, ObjectiveRecipe] = {
    "none": ObjectiveRecipe(
        None,
        convolutions="rnd",
        encoder_gain=ROOT_2,
        published="elu",
        distillation=DISTILLATION["none"],
    ),
    "contrastive": ObjectiveRecipe(
        objectives.contrastive,
        convolutions="snd_v",
        encoder_gain=ROOT_2,
        published="elu",
        distillation=DISTILLATION["contrastive"],
    ),
    "st_dim": ObjectiveRecipe(
        objectives.st_dim,
        predictor_gain=0.5,
        distillation=DISTILLATION["st_dim"],
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


def find_objective(objective: AnyObjective, options: Mapping[str, Any]) -> ObjectiveRecipe:
    """Return the recipe of an objective that is given by name or as a value.

    Args:
      objective: see `make_module`.
      options: arguments of its constructor.

    Raises:
      ValueError: there is no objective of this name, those there are are named; or options are
        given to an objective that is made already.
    """
    if isinstance(objective, str):
        return find(OBJECTIVES, "objective", objective)
    if isinstance(objective, ObjectiveRecipe):
        return objective
    if isinstance(objective, Objective):
        check_no_options("objective", objective, options)
        made = objective
        return ObjectiveRecipe(lambda: made)
    return ObjectiveRecipe(objective)


def make_signal(
    signal: AnySignal,
    predictor: Encoder,
    distillation: Mapping[str, Any],
    options: Mapping[str, Any] = {},
) -> Signal:
    """Make a signal with its options and those of the other arguments that its constructor takes.

    Args:
      signal: see `make_module`.
      predictor: the network that copies the encoder.
      distillation: how signals with a predictor reduce.
      options: further arguments of the constructor.

    Raises:
      ValueError: there is no signal of this name, or the constructor has no such option; those
        there are are named.
    """
    if isinstance(signal, Signal):
        check_no_options("signal", signal, options)
        return signal
    make = find(SIGNALS, "signal", signal) if isinstance(signal, str) else signal
    takes = signature(make).parameters
    given: dict[str, Any] = {}
    if "predictor" in takes:
        given["predictor"] = predictor
        given |= {name: value for name, value in distillation.items() if name in takes}
    if unknown := set(options) - set(takes):
        known = ", ".join(sorted(set(takes) - {"predictor"}))
        name = getattr(make, "__name__", "given")
        raise ValueError(f"signal {name} has no option {min(unknown)}; it has {known}")
    return make(**{**given, **options})


def find(known: Mapping[str, T], what: str, name: str) -> T:
    """Return the entry of a name.

    Args:
      known: the entries.
      what: the kind of thing.
      name: which one.

    Raises:
      ValueError: there is none; those there are are named.
    """
    if name not in known:
        raise ValueError(f"unknown {what} '{name}'; there is {', '.join(known)}")
    return known[name]


def check_no_options(what: str, made: Any, options: Mapping[str, Any]) -> None:
    """Check that no options are given to something that is made already.

    Args:
      what: the kind of thing.
      made: the thing.
      options: of its constructor.

    Raises:
      ValueError: there are options.
    """
    if options:
        raise ValueError(f"{what} {made!r} is made already; give its options to its constructor")


def make_encoder_and_predictor(
    recipe: ObjectiveRecipe,
    size: Architecture,
    activation: ModuleActivation,
    pairing: Pairing,
    action_inputs: int = 0,
) -> tuple[Encoder, Encoder]:
    """Make the encoder and the predictor that learns to copy it (Fig. 5.3b-c, 5.4).

    For vectors the asymmetric pairing is the same multi-layer perceptron twice.

    Args:
      recipe: what the objective's experiments ran.
      size: the sizes of the networks.
      activation: see `make_module`.
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
    torso: Activation = recipe.published if activation == "published" else activation
    between: Activation = "elu" if activation == "published" else activation
    extra = {"asymmetric": (0, 2), "two_linear": (1, 1)}.get(pairing, (0, 0))
    if not size.channels and pairing == "asymmetric":
        extra = (0, 0)

    def encoder(layers: tuple[Convolution, ...], gain: float, extra: int) -> Encoder:
        return Encoder(
            convolutions=layers,
            hidden=size.hidden,
            features=size.features,
            gain=gain,
            extra=extra,
            activation=torso,
            extra_activation=between,
            num_actions=action_inputs,
            layer_norm=size.layer_norm,
        )

    return (
        encoder(layers, recipe.encoder_gain, extra[0]),
        encoder(predictor_layers, recipe.predictor_gain, extra[1]),
    )


def make_module(
    objective: AnyObjective,
    signal: AnySignal,
    num_actions: int,
    size: Architecture = ATARI,
    *,
    preprocess: Preprocess = "none",
    activation: ModuleActivation = "elu",
    pairing: Pairing = "asymmetric",
    action_input: bool = False,
    weights: tuple[float, float] = (1.0, 1.0),
    objective_options: Mapping[str, Any] = {},
    signal_options: Mapping[str, Any] = {},
) -> IntrinsicModule:
    """Make any cell of the grid: an objective with a signal, ours by name or one's own as values.

    `rnd`, `icm` and `sp` add settings of their own to theirs, see `sndjax.algorithm_table`.

    Args:
      objective: a name in `OBJECTIVES` ("none" is a random encoder that stays as it is); an
        `Objective`, or its constructor, whose networks are then those of VICReg; or an
        `ObjectiveRecipe`, which says what the networks are.
      signal: a name in `SIGNALS`; a `Signal`; or its constructor, which gets the arguments
        `predictor`, the network that copies the encoder, if it takes one.
      num_actions: A.
      size: the sizes of the networks.
      preprocess: what frames go through first: "none", "mean" or "standardize" (5.2.2).
      activation: "elu", "relu", "leaky_relu", "tanh", or "published": that of each method's
        experiments.
      pairing: of predictor and target (Fig. 5.4), where there is a predictor.
      action_input: the encoder and the predictor take the action as input.
      weights: of the objective's and of the signal's loss.
      objective_options: arguments of the objective's constructor.
      signal_options: arguments of the signal's constructor.

    Raises:
      ValueError: there is no such objective or signal, the known ones are named; an option is none
        of its words; `action_input`, and this is not distillation without an objective (QRND); or
        the signal has no such option.

    >>> from sndjax import VECTOR
    >>> make_module("inverse_dynamics", "re3", 3, VECTOR)  # doctest: +ELLIPSIS
    IntrinsicModule(objective=inverse_dynamics(last=1.0), signal=re3(k=4, average=True, ...
    """
    check_choice("preprocess", preprocess, get_args(Preprocess))
    check_choice("activation", activation, get_args(ModuleActivation))
    check_choice("pairing", pairing, get_args(Pairing))
    recipe = find_objective(objective, objective_options)
    copies = signal in ("distillation", SIGNALS["distillation"])
    if action_input and (recipe.objective is not None or not copies):
        raise ValueError("action_input is for the signal 'distillation' without an objective")
    encoder, predictor = make_encoder_and_predictor(
        recipe, size, activation, pairing, num_actions if action_input else 0
    )
    return make_intrinsic_module(
        encoder,
        recipe.objective(**objective_options) if recipe.objective else None,
        make_signal(signal, predictor, recipe.distillation, signal_options),
        num_actions,
        preprocess=preprocess,
        weights=weights,
    )
