"""The nouns of sndjax: every type that crosses a file, with its shapes.

T is the rollout length, N the number of environments, B a minibatch, d the
feature width, K the number of value heads. A *frame* is one observation without
its stack: `uint8[H, W, C]` for pixels, `float32[D]` for vectors.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

Params = Any  # a pytree of arrays
State = Any  # a pytree of arrays
Metrics = dict[str, Float[Array, ""]]


class Rollout(NamedTuple):
    """T steps of N environments, each frame stored once.

    `frames[t + 1]` is the state that followed `frames[t]` for every valid row, the
    true last observation of an episode included. A row that is not valid is an
    environment resetting itself: its frames come from two different episodes.
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

    The first B of `frames` are s_t, the last B are s_t+1. Rows that are drawn have 2B of them;
    rows of consecutive steps share theirs, so that an encoder sees B + N.

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

    def now(self, x: Shaped[Array, "M ..."]) -> Shaped[Array, "B ..."]:
        """Of something that belongs to `frames`, what belongs to s_t."""
        return x[: self.valid.shape[0]]

    def then(self, x: Shaped[Array, "M ..."]) -> Shaped[Array, "B ..."]:
        """Of something that belongs to `frames`, what belongs to s_t+1."""
        return x[x.shape[0] - self.valid.shape[0] :]

    @property
    def frame(self) -> Shaped[Array, "B *frame"]:
        """s_t of every row."""
        return self.now(self.frames)

    @property
    def next_frame(self) -> Shaped[Array, "B *frame"]:
        """s_t+1 of every row."""
        return self.then(self.frames)


class Features(NamedTuple):
    """What an encoder made of a minibatch, computed once and shared by objective and signal."""

    z: Float[Array, "B d"]
    z_next: Float[Array, "B d"]
    local: Float[Array, "B I J C"]  # an intermediate layer, kept in its positions
    local_next: Float[Array, "B I J C"]


Encode = Callable[..., tuple[Float[Array, "B d"], Float[Array, "B I J C"]]]


class View(NamedTuple):
    """How a module sees frames, with the encoder's weights of the moment.

    prepare: frames[B, *frame] -> what networks read (section 5.2.2)
    encode:  (frames[B, *frame], action=None) -> (z[B, d], local[B, I, J, C]), prepared inside;
             the action is for encoders that take it in
    """

    prepare: Callable[[Shaped[Array, "B *frame"]], Shaped[Array, "B *frame"]]
    encode: Encode


class Average(NamedTuple):
    """The slow copy of an objective and of its encoder: moving averages of their weights."""

    params: Params
    encode: Encode


class Objective(NamedTuple):
    """A self-supervised loss that shapes an encoder. All of it is pure.

    init: (key, features, num_actions) -> params
    loss: (params, encode, features, batch, rollout, key) -> (scalar, metrics)

    `encode` maps further frames through the encoder that made `features`. `pairs` is False
    where the loss does not read the features of s_t+1. With a `decay` the module keeps an
    `Average` (slow = decay * slow + (1 - decay) * now after each optimizer step), and the
    loss gets it as `average=`.
    """

    init: Callable[[PRNGKeyArray, Features, int], Params]
    loss: Callable[..., tuple[Float[Array, ""], Metrics]]
    pairs: bool = True
    decay: float | None = None


class Signal(NamedTuple):
    """A novelty signal that is read off an encoder. All of it is pure.

    init:   (key, example[N, *frame], features, num_actions) -> (params, state)
    reward: (params, state, view, rollout, key) -> (float32[T, N], state); what it gives on
            reset rows does not matter, what it keeps of them does
    loss:   (params, state, view, features, batch, key) -> (scalar, metrics)

    `pairs` is True where the loss reads the features of s_t+1.
    """

    init: Callable[[PRNGKeyArray, Shaped[Array, "N *frame"], Features, int], tuple[Params, State]]
    reward: Callable[
        [Params, State, View, Rollout, PRNGKeyArray], tuple[Float[Array, "T N"], State]
    ]
    loss: Callable[
        [Params, State, View, Features, Transition, PRNGKeyArray],
        tuple[Float[Array, ""], Metrics],
    ]
    pairs: bool = False


class IntrinsicModule(NamedTuple):
    """A novelty bonus: an encoder, an objective and a signal as four pure functions.

    init:   (key, example[N, *frame]) -> (params, state)
    reward: (params, state, rollout, key) -> (float32[T, N], state), the signal, unscaled
    loss:   (params, state, batch, rollout, key) -> (scalar, metrics), differentiated in params
    update: (params, state) -> state, after each optimizer step
    features: (params, state, frames[B, *frame], action=None) -> float32[B, d], the encoder's, to
            look at; None where a module has none to show

    >>> IntrinsicModule(*4 * [lambda *args: None]).features is None
    True
    """

    init: Callable[[PRNGKeyArray, Shaped[Array, "N *frame"]], tuple[Params, State]]
    reward: Callable[[Params, State, Rollout, PRNGKeyArray], tuple[Float[Array, "T N"], State]]
    loss: Callable[
        [Params, State, Transition, Rollout, PRNGKeyArray],
        tuple[Float[Array, ""], Metrics],
    ]
    update: Callable[[Params, State], State]
    features: Callable[..., Float[Array, "B d"]] | None = None


class Moments(NamedTuple):
    """Running mean and spread of a stream of arrays, weighted by sample counts."""

    samples: Float[Array, ""]
    mean: Float[Array, "*shape"]
    m2: Float[Array, "*shape"]  # sum of squared distances from the mean


class ReturnScale(NamedTuple):
    """The running spread of a reward's discounted sum over time."""

    moments: Moments
    discounted: Float[Array, " N"]  # the sum so far, one per environment


class TrainState(NamedTuple):
    """Everything that learning changes, in one pytree."""

    policy: Params
    policy_optimizer: optax.OptState
    intrinsic: Params
    intrinsic_optimizer: optax.OptState
    intrinsic_state: State
    reward_scale: ReturnScale
    observations: Moments  # of vector observations; empty for pixels
    key: PRNGKeyArray
    iteration: Int[Array, ""]
