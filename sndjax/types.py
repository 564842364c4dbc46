"""Shared types, with array shapes.

T is the rollout length, N the number of environments, B a minibatch, d the feature width, K the
number of value heads, A the number of actions. A *frame* is one observation without its stack:
`uint8[H, W, C]` for pixels, `float32[D]` for vectors. What an objective, a signal and a module are
made of is in `sndjax/protocols.py`.
"""

from typing import Any, NamedTuple

import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

Params = Any  # a pytree of arrays
State = Any  # a pytree of arrays
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
    truncated: Bool[Array, "T N"]  # done by a step limit alone; False where the game ended too
    log_prob: Float[Array, "T N"]  # of `action`, when it was chosen
    value: Float[Array, "T+1 N K"]  # external first, intrinsic second
    hidden: Float[Array, "N d"] | None = None  # a recurrent policy's state before the rollout


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
        """Return the frame s_t of every row."""
        return self.at_t(self.frames)

    @property
    def next_frame(self) -> Shaped[Array, "B *frame"]:
        """Return the frame s_t+1 of every row."""
        return self.at_next(self.frames)


class Features(NamedTuple):
    """What an encoder makes of a minibatch, computed once and shared by objective and signal."""

    z: Float[Array, "B d"]
    z_next: Float[Array, "B d"]
    local: Float[Array, "B I J C"]  # an intermediate layer, kept in its positions
    local_next: Float[Array, "B I J C"]


class RunningStatistics(NamedTuple):
    """Running mean and variance of a stream of arrays, weighted by sample counts."""

    samples: Float[Array, ""]
    mean: Float[Array, "*shape"]
    m2: Float[Array, "*shape"]  # sum of squared distances from the mean


class ReturnStatistics(NamedTuple):
    """Running statistics of a reward's discounted sum over time."""

    moments: RunningStatistics
    discounted: Float[Array, " N"]  # the sum so far, one per environment


class TargetWeights(NamedTuple):
    """The averaged weights of an encoder and of its objective."""

    encoder: Params
    objective: Params


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
    moments: RunningStatistics | None
    signal: State
    slow: TargetWeights | None


class TrainState(NamedTuple):
    """Everything that learning changes, in one pytree."""

    policy: Params
    policy_optimizer: optax.OptState
    intrinsic: Params
    intrinsic_optimizer: optax.OptState
    intrinsic_state: State
    reward_scale: ReturnStatistics
    observations: RunningStatistics  # of vector observations; empty for pixels
    ext_returns: ReturnStatistics | None  # of external rewards; None: they are not normalised
    key: PRNGKeyArray
    iteration: Int[Array, ""]
