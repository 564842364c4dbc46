"""Shared types, with array shapes.

T is the rollout length, N the number of environments, B a minibatch, d the feature width, K the
number of value heads, A the number of actions. A *frame* is one observation without its stack:
`uint8[H, W, C]` for pixels, `float32[D]` for vectors.

An objective, a signal and a module are records of pure functions; the Protocols say what each
function gets and returns.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

Params = Any  # a pytree of arrays
State = Any  # a pytree of arrays
Scalar = Float[Array, ""]
Metrics = dict[str, Float[Array, ""]]
Loss = tuple[Float[Array, ""], Metrics]  # the scalar to differentiate, and what to log


class Rollout(NamedTuple):
    """T steps of N environments, each frame stored once.

    `frames[t + 1]` is the state that followed `frames[t]` for every valid row, the true last
    observation of an episode included. A row that is not valid is an environment resetting
    itself: its frames come from two different episodes.
    """

    frames: Shaped[Array, "T+1 N *frame"]
    action: Int[Array, "T N"]  # the one the policy chose, not the one a sticky key made of it
    first: Bool[Array, "T N"]  # frames[t] opens an episode
    done: Bool[Array, "T N"]  # the episode ended with this row
    valid: Bool[Array, "T N"]  # False: a reset row, no transition


class Experience(NamedTuple):
    """A rollout with what the policy needs to learn from it: the `batch` of `train_step`."""

    rollout: Rollout
    history: Shaped[Array, "S-1 N *frame"]  # the older frames of the first stack, oldest first
    reward: Float[Array, "T N"]  # the environment's training reward
    truncated: Bool[Array, "T N"]  # done by a step limit rather than by the game
    log_prob: Float[Array, "T N"]  # of `action`, when it was chosen
    value: Float[Array, "T+1 N K"]  # external first, intrinsic second


class Transition(NamedTuple):
    """A minibatch of rows of a rollout.

    The first B of `frames` are s_t, the last B are s_t+1. Rows that are drawn at random have 2B
    of them; rows of consecutive steps share theirs, so that an encoder sees B + N.

    >>> import jax.numpy as jnp
    >>> batch = Transition(jnp.arange(5), *4 * [jnp.zeros(3)])
    >>> batch.frame, batch.next_frame
    (Array([0, 1, 2], dtype=int32), Array([2, 3, 4], dtype=int32))
    """

    frames: Shaped[Array, "M *frame"]  # M >= B
    action: Int[Array, " B"]
    first: Bool[Array, " B"]
    done: Bool[Array, " B"]
    valid: Bool[Array, " B"]

    def at_t(self, x: Shaped[Array, "M ..."]) -> Shaped[Array, "B ..."]:
        """Return the entries of s_t, of an array with one entry for each of `frames`."""
        return x[: self.valid.shape[0]]

    def at_next(self, x: Shaped[Array, "M ..."]) -> Shaped[Array, "B ..."]:
        """Return the entries of s_t+1, of an array with one entry for each of `frames`."""
        return x[x.shape[0] - self.valid.shape[0] :]

    @property
    def frame(self) -> Shaped[Array, "B *frame"]:
        """The frame s_t of every row."""
        return self.at_t(self.frames)

    @property
    def next_frame(self) -> Shaped[Array, "B *frame"]:
        """The frame s_t+1 of every row."""
        return self.at_next(self.frames)


class Features(NamedTuple):
    """What an encoder makes of a minibatch, computed once and shared by objective and signal."""

    z: Float[Array, "B d"]
    z_next: Float[Array, "B d"]
    local: Float[Array, "B I J C"]  # an intermediate layer, kept in its positions
    local_next: Float[Array, "B I J C"]


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
      name: of its file.
      settings: the arguments it was made with.
    """

    init: SignalInit
    reward: SignalReward
    loss: SignalLoss
    needs_pairs: bool = False
    has_published_scale: bool = True
    name: str = "signal"
    settings: Mapping[str, Any] = {}

    def __repr__(self) -> str:
        return describe_call(self.name, self.settings)


@runtime_checkable
class ModuleInit(Protocol):
    """How a module makes its parameters and its state."""

    def __call__(
        self, key: PRNGKeyArray, example: Shaped[Array, "N *frame"]
    ) -> tuple[Params, State]:
        """Return the parameters, which are trained, and the state, which is not.

        Args:
          key: of the random draws.
          example: frames of all N environments, for their shape and dtype.
        """


@runtime_checkable
class ModuleReward(Protocol):
    """How a module's signal is read."""

    def __call__(
        self,
        params: Params,
        state: State,
        rollout: Rollout,
        key: PRNGKeyArray,
        update_statistics: bool = True,
    ) -> tuple[Float[Array, "T N"], State]:
        """Return the novelty of every row, unscaled, 0 at invalid rows, and the new state.

        Args:
          params: of the module.
          state: of the module; episodic memory moves here.
          rollout: what to read.
          key: of the random draws.
          update_statistics: add the rollout to the running statistics of the input before it is
            read. False reads it with the statistics as they are.
        """


@runtime_checkable
class ModuleLoss(Protocol):
    """How a module is trained."""

    def __call__(
        self,
        params: Params,
        state: State,
        batch: Transition,
        rollout: Rollout,
        key: PRNGKeyArray,
    ) -> Loss:
        """Return the scalar to differentiate in `params`, and metrics to log.

        Args:
          params: of the module; everything that is trained.
          state: of the module.
          batch: the minibatch.
          rollout: the rollout that it is from.
          key: of the random draws.
        """


@runtime_checkable
class ModuleUpdate(Protocol):
    """How a module's state follows its parameters."""

    def __call__(self, params: Params, state: State) -> State:
        """Return the state after an optimizer step: moving averages move.

        Args:
          params: after the step.
          state: before it.
        """


@runtime_checkable
class ModuleFeatures(Protocol):
    """How a module's features are looked at."""

    def __call__(
        self,
        params: Params,
        state: State,
        frames: Shaped[Array, "B *frame"],
        action: Int[Array, " B"] | None = None,
    ) -> Float[Array, "B d"]:
        """Return the encoder's features of a batch of frames.

        Args:
          params: of the module.
          state: of the module.
          frames: observations.
          action: for encoders that take the action as input (QRND).
        """


class IntrinsicModule(NamedTuple):
    """A novelty bonus: an encoder, an objective and a signal as a record of pure functions.

    Attributes:
      init: makes params and state.
      reward: the signal of a rollout, unscaled.
      loss: the loss of a minibatch.
      update: moves the state after each optimizer step.
      features: the encoder's features, to look at; None where a module has none to show.
      has_published_scale: the signal's unit is that of the published experiments' eta.
      description: the objective and the signal with their settings.

    >>> IntrinsicModule(*4 * [lambda *args: None])
    IntrinsicModule(a module of one's own)
    """

    init: ModuleInit
    reward: ModuleReward
    loss: ModuleLoss
    update: ModuleUpdate
    features: ModuleFeatures | None = None
    has_published_scale: bool = True
    description: str = "a module of one's own"

    def __repr__(self) -> str:
        return f"IntrinsicModule({self.description})"


class ModuleParams(NamedTuple):
    """The parameters of a composed module.

    Attributes:
      encoder: the encoder's weights; None where no objective trains them.
      objective: the objective's own; None where there is none.
      signal: the signal's own.
    """

    encoder: Params | None
    objective: Params | None
    signal: Params


class ModuleState(NamedTuple):
    """The state of a composed module. The names are those of checkpoints, and stay.

    Attributes:
      encoder: the weights of an encoder that stays random; None where an objective trains it.
      moments: the running statistics of the input; None without preprocessing.
      signal: the signal's own.
      slow: the target networks' weights; None without an `ema_decay`.
    """

    encoder: Params | None
    moments: "RunningStatistics | None"
    signal: State
    slow: "TargetWeights | None"


class TargetWeights(NamedTuple):
    """The averaged weights of an encoder and of its objective."""

    encoder: Params
    objective: Params


class RunningStatistics(NamedTuple):
    """Running mean and variance of a stream of arrays, weighted by sample counts."""

    samples: Float[Array, ""]
    mean: Float[Array, "*shape"]
    m2: Float[Array, "*shape"]  # sum of squared distances from the mean


class ReturnStatistics(NamedTuple):
    """Running statistics of a reward's discounted sum over time."""

    moments: RunningStatistics
    discounted: Float[Array, " N"]  # the sum so far, one per environment


class TrainState(NamedTuple):
    """Everything that learning changes, in one pytree."""

    policy: Params
    policy_optimizer: optax.OptState
    intrinsic: Params
    intrinsic_optimizer: optax.OptState
    intrinsic_state: State
    reward_scale: ReturnStatistics
    observations: RunningStatistics  # of vector observations; empty for pixels
    key: PRNGKeyArray
    iteration: Int[Array, ""]


def describe_call(name: str, settings: Mapping[str, Any]) -> str:
    """Return a call in words.

    >>> describe_call("re3", {"k": 3})
    're3(k=3)'
    """
    return f"{name}({', '.join(f'{key}={value!r}' for key, value in settings.items())})"
