"""What an objective and a signal are made of: Protocols of pure functions, and records of them.

Shapes are named as in `sndjax/types.py`; a module is `sndjax/intrinsic_module.py`.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from sndjax.types import Features, Loss, Params, Rollout, State, Transition


@runtime_checkable
class Encode(Protocol):
    """An encoder with its weights of the moment, preprocessing included."""

    def __call__(
        self, frames: Shaped[Array, "B *frame"], action: Int[Array, " B"] | None = None
    ) -> tuple[Float[Array, "B d"], Float[Array, "B I J C"]]:
        """Return features z and the local map of a batch of frames.

        Args:
          frames: observations, as the environment gives them.
          action: for encoders that take the action as input (QRND).
        """


class EncoderView(NamedTuple):
    """How a module sees frames, with the encoder's weights of the moment.

    Attributes:
      preprocess: frames[B, *frame] -> what networks read (section 5.2.2).
      encode: frames -> (z, local), preprocessing included.
    """

    preprocess: Callable[[Shaped[Array, "B *frame"]], Shaped[Array, "B *frame"]]
    encode: Encode


class TargetNetwork(NamedTuple):
    """The target of an objective: exponential moving averages of its and its encoder's weights.

    Attributes:
      params: the averaged params of the objective.
      encode: the encoder with averaged weights.
    """

    params: Params
    encode: Encode


@runtime_checkable
class ObjectiveInit(Protocol):
    """How an objective makes its parameters."""

    def __call__(self, key: PRNGKeyArray, features: Features, num_actions: int) -> Params:
        """Return the objective's own parameters, such as heads.

        Args:
          key: of the random draws.
          features: of a batch of one, for their shapes.
          num_actions: A, of the environment.
        """


@runtime_checkable
class ObjectiveLoss(Protocol):
    """How an objective computes its loss."""

    def __call__(
        self,
        params: Params,
        encode: Encode,
        features: Features,
        batch: Transition,
        rollout: Rollout,
        key: PRNGKeyArray,
    ) -> Loss:
        """Return the scalar loss over the valid rows, and metrics to log.

        Args:
          params: the objective's own.
          encode: maps further frames through the encoder that made `features`.
          features: of the minibatch.
          batch: the minibatch; what invalid rows hold is replaced by zeros.
          rollout: the whole rollout, for objectives that draw their own rows.
          key: of the random draws.
        """


@runtime_checkable
class TargetObjectiveLoss(Protocol):
    """How an objective with an `ema_decay` computes its loss."""

    def __call__(
        self,
        params: Params,
        encode: Encode,
        features: Features,
        batch: Transition,
        rollout: Rollout,
        key: PRNGKeyArray,
        *,
        target: TargetNetwork,
    ) -> Loss:
        """Return the scalar loss and metrics, as `ObjectiveLoss` does.

        Args:
          params: the objective's own.
          encode: maps further frames through the encoder that made `features`.
          features: of the minibatch.
          batch: the minibatch.
          rollout: the whole rollout.
          key: of the random draws.
          target: the averaged networks.
        """


class Objective(NamedTuple):
    """A self-supervised loss that shapes an encoder: a record of pure functions.

    Attributes:
      init: makes the objective's own parameters.
      loss: the loss of a minibatch.
      needs_pairs: the loss reads the features of s_t+1.
      ema_decay: with one, the module keeps a `TargetNetwork`: target = ema_decay * target +
        (1 - ema_decay) * online after each optimizer step, and passes it to `loss` as `target=`.
      name: of its file.
      settings: the arguments it was made with.
    """

    init: ObjectiveInit
    loss: ObjectiveLoss | TargetObjectiveLoss
    needs_pairs: bool = True
    ema_decay: float | None = None
    name: str = "objective"
    settings: Mapping[str, Any] = {}

    def __repr__(self) -> str:
        return describe_call(self.name, self.settings)


@runtime_checkable
class SignalInit(Protocol):
    """How a signal makes its parameters and its state."""

    def __call__(
        self,
        key: PRNGKeyArray,
        example: Shaped[Array, "N *frame"],
        features: Features,
        num_actions: int,
    ) -> tuple[Params, State]:
        """Return the parameters, which are trained, and the state, which is not.

        Args:
          key: of the random draws.
          example: frames of all N environments, for their shape and dtype.
          features: of a batch of one, for their shapes.
          num_actions: A, of the environment.
        """


@runtime_checkable
class SignalReward(Protocol):
    """How a signal is read."""

    def __call__(
        self,
        params: Params,
        state: State,
        view: EncoderView,
        rollout: Rollout,
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, "T N"], State]:
        """Return the novelty of every row, unscaled, and the state after the rollout.

        Values at invalid rows are ignored; the state must not be updated from invalid rows.

        Args:
          params: the signal's own.
          state: the signal's own, such as episodic memory.
          view: the encoder.
          rollout: what to read.
          key: of the random draws.
        """


@runtime_checkable
class SignalLoss(Protocol):
    """How a signal's own networks are trained."""

    def __call__(
        self,
        params: Params,
        state: State,
        view: EncoderView,
        features: Features,
        batch: Transition,
        key: PRNGKeyArray,
    ) -> Loss:
        """Return the scalar loss over the valid rows, and metrics to log.

        Args:
          params: the signal's own.
          state: the signal's own.
          view: the encoder.
          features: of the minibatch.
          batch: the minibatch; what invalid rows hold is replaced by zeros.
          key: of the random draws.
        """


class Signal(NamedTuple):
    """A novelty signal that is read off an encoder: a record of pure functions.

    Attributes:
      init: makes params and state.
      reward: the signal of a rollout.
      loss: trains the signal's own networks.
      needs_pairs: the loss reads the features of s_t+1.
      has_published_scale: its unit is that of the published experiments' eta. False: use a
        running scale (`reward_scale="running_std"`).
      episodic: its state is a memory of the running episode of each environment.
      name: of its file.
      settings: the arguments it was made with.
    """

    init: SignalInit
    reward: SignalReward
    loss: SignalLoss
    needs_pairs: bool = False
    has_published_scale: bool = True
    episodic: bool = False
    name: str = "signal"
    settings: Mapping[str, Any] = {}

    def __repr__(self) -> str:
        return describe_call(self.name, self.settings)


@runtime_checkable
class EnvironmentReset(Protocol):
    """How an environment that lives in JAX begins an episode."""

    def __call__(self, key: PRNGKeyArray, /) -> tuple[State, Shaped[Array, "*frame"]]:
        """Return the state and the observation at the start of an episode.

        Args:
          key: of the random draws.
        """


@runtime_checkable
class EnvironmentStep(Protocol):
    """How an environment that lives in JAX takes one step."""

    def __call__(
        self, key: PRNGKeyArray, state: State, action: Int[Array, ""], /
    ) -> tuple[State, Shaped[Array, "*frame"], Float[Array, ""], Bool[Array, ""], Bool[Array, ""]]:
        """Return state, observation, reward, whether the task ended the episode, or a limit.

        The observation is that of the state after the step, at an episode's end too.

        Args:
          key: of the random draws.
          state: before the step.
          action: 0 to A - 1.
        """


def describe_call(name: str, settings: Mapping[str, Any]) -> str:
    """Return a call in words.

    >>> describe_call("re3", {"k": 3})
    're3(k=3)'
    """
    return f"{name}({', '.join(f'{key}={value!r}' for key, value in settings.items())})"
