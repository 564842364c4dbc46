"""What an intrinsic module is made of: four pure functions and one to look at features.

Shapes are named as in `sndjax/types.py`.
"""

from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Float, Int, PRNGKeyArray, Shaped

from sndjax.types import Loss, Params, Rollout, State, Transition


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
      episodic: the state holds a memory of the running episode of each environment.

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
    episodic: bool = False

    def __repr__(self) -> str:
        return f"IntrinsicModule({self.description})"
