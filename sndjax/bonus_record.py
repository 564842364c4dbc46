"""What a bonus for a training loop of one's own is: its settings, its state, its functions."""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, Protocol, TypedDict, get_args, runtime_checkable

from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from sndjax.checks import check_choice
from sndjax.intrinsic_module import IntrinsicModule
from sndjax.intrinsic_training import IntrinsicTrainState
from sndjax.scaling import RewardScale
from sndjax.types import Metrics, ReturnStatistics, RunningStatistics

Reset = Literal["same_step", "next_step"]


class BonusSettings(NamedTuple):
    """How a bonus is scaled and trained.

    Attributes:
      eta: the scale of the reward.
      reward_scale: "none": clip(eta * signal, 0, 1), as the thesis; "running_std": eta * signal
        over the running deviation of its discounted sum, which needs no search for eta.
      discount: of that sum.
      learning_rate: of Adam.
      minibatch_size: rows of an optimizer step, about: minibatches of a rollout are equally large.
      epochs: passes over each rollout.
      shuffle: draw the rows of a minibatch at random; False: they follow each other in time.
      standardize: subtract the running mean from observations, divide by the running deviation,
        clip at 5 deviations. For vectors; pixels have the module's own `preprocess`.
      reset: what the environments do after an episode's last step. "same_step": the step that ends
        returns the next episode's first observation (gymnax, brax, Stoix, most loops in JAX);
        "next_step": the step after it does, and its action is ignored (EnvPool, gymnasium).
    """

    eta: float = 0.5
    reward_scale: RewardScale = "none"
    discount: float = 0.99
    learning_rate: float = 1e-4
    minibatch_size: int = 512
    epochs: int = 1
    shuffle: bool = False
    standardize: bool = False
    reset: Reset = "same_step"


# "thesis" is what the thesis set, for images; "small" is ours, for tasks of minutes on a few cores:
# the scale that needs no search, a learning rate ten times as large, smaller minibatches.
PRESETS: Mapping[str, BonusSettings] = {
    "thesis": BonusSettings(),
    "small": BonusSettings(
        eta=1.0,
        reward_scale="running_std",
        learning_rate=1e-3,
        minibatch_size=128,
        shuffle=True,
    ),
}


class BonusChanges(TypedDict, total=False):
    """The fields of `BonusSettings` as keywords, any of them, for type checkers."""

    eta: float
    reward_scale: RewardScale
    discount: float
    learning_rate: float
    minibatch_size: int
    epochs: int
    shuffle: bool
    standardize: bool
    reset: Reset


def check_settings(settings: Mapping[str, Any]) -> None:
    """Check the names of settings, those whose values are words, and those that count.

    Args:
      settings: fields of `BonusSettings`.

    Raises:
      ValueError: there is no such setting or word, those there are are named; or a count is 0.
    """
    if unknown := set(settings) - set(BonusSettings._fields):
        known = ", ".join(BonusSettings._fields)
        raise ValueError(f"a bonus has no setting {min(unknown)}; it has {known}")
    check_choice("reset", settings.get("reset", "same_step"), get_args(Reset))
    check_choice("reward_scale", settings.get("reward_scale", "none"), get_args(RewardScale))
    for name in ("minibatch_size", "epochs"):
        if settings.get(name, 1) < 1:
            raise ValueError(f"{name}={settings[name]}; it must be 1 or more")


class BonusState(NamedTuple):
    """Everything of a bonus that changes, in one pytree."""

    trained: IntrinsicTrainState  # parameters, optimizer, and the module's own state
    returns: ReturnStatistics  # of the signal, for `reward_scale="running_std"`
    observations: RunningStatistics  # empty without `standardize`
    first: Bool[Array, " N"]  # the next row opens an episode
    reset: Bool[Array, " N"]  # the next row is a reset; only where `reset="next_step"`
    key: PRNGKeyArray


@runtime_checkable
class BonusInit(Protocol):
    """How the state of a bonus is made."""

    def __call__(self, key: PRNGKeyArray, obs: Shaped[Array, "N *frame"]) -> BonusState:
        """Return the state before any step.

        Args:
          key: of the random draws, these and all that follow.
          obs: the first observations of all N environments.

        Raises:
          ValueError: `obs` has another shape or dtype than the example.
        """


@runtime_checkable
class BonusStep(Protocol):
    """How a rollout is rewarded and learned."""

    def __call__(
        self,
        state: BonusState,
        obs: Shaped[Array, "T N *frame"],
        action: Int[Array, "T N"],
        next_obs: Shaped[Array, "T N *frame"] | None = None,
        done: Shaped[Array, "T N"] | None = None,
        *,
        last_obs: Shaped[Array, "N *frame"] | None = None,
        train: bool = True,
    ) -> tuple[Float[Array, "T N"], BonusState, Metrics]:
        """Return the intrinsic reward of T steps, with the weights before, and train on them.

        Add the reward to that of the environment, or learn a value of its own from it. Rows that
        are no transition get 0.

        Args:
          state: before.
          obs: what the policy saw.
          action: what it did, 0 to A - 1.
          next_obs: the true next observation, of an episode's last step too.
          done: the episode ended with this step, for whatever reason. Booleans, or numbers of
            which only 0 is False.
          last_obs: in place of `next_obs`, for loops that keep only what they acted on: what the
            last step returned. With `reset="same_step"` the observation that an episode ended in
            is lost, and its last step gets 0.
          train: False: read only; episode memories and running statistics still move.

        Returns:
          The reward, the state after, and metrics (scalars). Two of them count mistakes that are
          seen only inside `jax.jit`, and must be 0: `unknown_actions`, and `resets_as_next_obs`,
          ends of episodes whose `next_obs` is the first observation of the next episode.

        Raises:
          ValueError: an array has another shape or dtype than the example says, or an action is
            not below A (where its value is known, outside of `jax.jit`).
        """


@runtime_checkable
class BonusStepBatch(Protocol):
    """How a batch of a replay buffer is rewarded and learned."""

    def __call__(
        self,
        state: BonusState,
        obs: Shaped[Array, "B *frame"],
        action: Int[Array, " B"],
        next_obs: Shaped[Array, "B *frame"],
        *,
        valid: Shaped[Array, " B"] | None = None,
        train: bool = True,
    ) -> tuple[Float[Array, " B"], BonusState, Metrics]:
        """Return the intrinsic reward of B transitions in no order, and train on them.

        Args:
          state: before.
          obs: what the policy saw.
          action: what it did.
          next_obs: the next observation.
          valid: the rows whose `next_obs` is the true one, not the first of another episode; the
            others get 0 and are not trained on. Booleans, or numbers of which only 0 is False.
            None: all.
          train: False: read only; running statistics still move.

        Returns:
          The reward, the state after, and metrics (scalars). A running scale is that of the signal
          itself, since rows in no order have no discounted sum.

        Raises:
          ValueError: the signal remembers episodes; or as `step`.
        """


class Bonus(NamedTuple):
    """An intrinsic reward for a loop of one's own: pure functions, made by `bonus`.

    Attributes:
      init: makes the state.
      step: rewards T steps of N environments, and trains on them.
      step_batch: rewards B transitions of a replay buffer, and trains on them.
      module: the objective and the signal.
      settings: how they are scaled and trained.
    """

    init: BonusInit
    step: BonusStep
    step_batch: BonusStepBatch
    module: IntrinsicModule
    settings: BonusSettings

    def __repr__(self) -> str:
        return f"Bonus({self.module!r}, {self.settings!r})"
