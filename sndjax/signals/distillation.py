"""Distillation: the novelty of a state is how badly a learned network copies the encoder there."""

from typing import Literal, cast

import chex
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sndjax.convolution import to_float
from sndjax.networks import Encoder
from sndjax.rollout import map_steps
from sndjax.statistics import expand
from sndjax.types import Params, Signal, View


def distillation_error(
    learned: Float[Array, "B d"],
    target: Float[Array, "B d"],
    reduction: Literal["mean", "half_sum"] = "mean",
) -> Float[Array, " B"]:
    """The novelty of each state: the squared distance of its two feature vectors (eq. 4.23).

    Mean over d of (learned - target)^2, as the published experiments have the equation's sum;
    `half_sum`, half its sum over d, is RND's (Burda et al., 2018).

    >>> distillation_error(jnp.array([[2.0, 0.0]]), jnp.zeros((1, 2)))
    Array([2.], dtype=float32)
    """
    chex.assert_equal_shape([learned, target])
    squared = (learned - target) ** 2
    return jnp.mean(squared, axis=-1) if reduction == "mean" else jnp.sum(squared, axis=-1) / 2


def distillation_loss(
    learned: Float[Array, "B d"],
    target: Float[Array, "B d"],
    valid: Bool[Array, " B"],
    key: PRNGKeyArray | None = None,
    keep: float = 1.0,
    reduction: Literal["mean", "sum"] = "mean",
) -> Float[Array, ""]:
    """Squared error of the learned network against a target that no gradient moves.

    Args:
      learned, target: the features of a minibatch.
      valid: the rows that count.
      key: where `keep` < 1, draws the (row, feature) entries that count this time.
      keep: the share of entries that count (RND: a quarter).
      reduction: over the entries that count.

    >>> one = jnp.ones((2, 3))
    >>> distillation_loss(one, 3 * one, jnp.array([True, False]))
    Array(4., dtype=float32)
    """
    chex.assert_equal_shape([learned, target])
    counted = jnp.broadcast_to(expand(valid, learned), learned.shape)
    if keep < 1:
        assert key is not None, "keep < 1 draws entries with a key"
        counted &= jax.random.bernoulli(key, jnp.float32(keep), learned.shape)
    squared = (learned - lax.stop_gradient(target)) ** 2
    total = jnp.sum(jnp.where(counted, squared, jnp.zeros_like(squared)))
    if reduction == "sum":
        return total
    return total / jnp.maximum(jnp.sum(counted, dtype=learned.dtype), 1)


def copied(learned: Encoder, params: Params, view: View, frames, action) -> Float[Array, "B d"]:
    """The learned network's features of a batch of frames."""
    return cast(tuple[Array, Array], learned.apply(params, view.prepare(frames), action))[0]


def distillation(
    learned: Encoder,
    *,
    reading: Literal["mean", "half_sum"] = "mean",
    reduction: Literal["mean", "sum"] = "mean",
    keep: float = 1.0,
) -> Signal:
    """A learned network copies the encoder; its error is the novelty of s_t (eq. 4.23).

    With an encoder that stays as it was drawn this is RND; with one that an objective
    shapes, SND. The encoder is the target: no gradient of this loss reaches it.

    Args:
      learned: the network that copies.
      reading: how the reward reduces over features, see `distillation_error`.
      reduction, keep: how the loss does, see `distillation_loss`.

    >>> from sndjax import VECTOR, Encoder
    >>> distillation(Encoder((), VECTOR.hidden, VECTOR.features, gain=1.0))  # doctest: +ELLIPSIS
    Signal(init=...)
    """

    def init(key, example, features, num_actions):
        return learned.init(key, to_float(example[:1]), jnp.zeros(1, jnp.int32)), {}

    def reward(params, state, view, rollout, key):
        def novelty(frame, action):
            target, _ = view.encode(frame, action)
            return distillation_error(copied(learned, params, view, frame, action), target, reading)

        return map_steps(novelty, rollout.frames[:-1], rollout.action), state

    def loss(params, state, view, features, batch, key):
        copy = copied(learned, params, view, batch.frame, batch.action)
        total = distillation_loss(copy, features.z, batch.valid, key, keep, reduction)
        return total, {"distillation_loss": total}

    return Signal(init, reward, loss)


def novelty_of_all(
    learned: Encoder,
    params: Params,
    view: View,
    frames,
    z: Float[Array, "T1 N d"],
    reading: Literal["mean", "half_sum"],
) -> Float[Array, "T1 N"]:
    """The distillation error of every frame of a rollout, whose features `z` are known."""

    def novelty(frame, z):
        return distillation_error(copied(learned, params, view, frame, None), z, reading)

    return map_steps(novelty, frames, z)
