"""Distillation: the novelty of a state is how badly a predictor copies the encoder there."""

from typing import Literal, cast, get_args

import chex
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from sndjax.checks import check_choice
from sndjax.convolution import to_float
from sndjax.networks import Encoder, match_dtype
from sndjax.protocols import EncoderView, Signal
from sndjax.ranges import Share
from sndjax.rollout import map_over_time
from sndjax.statistics import broadcast_mask, mask_rows
from sndjax.types import Features, Loss, Params, Rollout, State, Transition

RewardReduction = Literal["mean", "half_sum", "norm"]
LossReduction = Literal["mean", "sum"]


def distillation_error(
    predictor_features: Float[Array, "B d"],
    target: Float[Array, "B d"],
    reward_reduction: RewardReduction = "mean",
) -> Float[Array, " B"]:
    """Compute the novelty of each state: the squared distance of its two feature vectors (4.23).

    Args:
      predictor_features: of the predictor.
      target: of the encoder.
      reward_reduction: "mean" over d of (predictor - target)^2, as the published experiments have
        the equation's sum; "half_sum", half the sum over d, is RND's (Burda et al., 2018); "norm",
        the square root of the sum, is NovelD's (Zhang et al., 2021).

    >>> distillation_error(jnp.array([[2.0, 0.0]]), jnp.zeros((1, 2)))
    Array([2.], dtype=float32)
    """
    chex.assert_equal_shape([predictor_features, target])
    squared = (predictor_features - target) ** 2
    if reward_reduction == "mean":
        return jnp.mean(squared, axis=-1)
    total = jnp.sum(squared, axis=-1)
    return jnp.sqrt(total) if reward_reduction == "norm" else total / 2


def distillation_loss(
    predictor_features: Float[Array, "B d"],
    target: Float[Array, "B d"],
    valid: Bool[Array, " B"],
    key: PRNGKeyArray | None = None,
    update_proportion: float = 1.0,
    loss_reduction: LossReduction = "mean",
) -> Float[Array, ""]:
    """Compute the squared error of the predictor against a target that no gradient moves.

    Args:
      predictor_features: of a minibatch.
      target: the encoder's features of it.
      valid: the rows that count.
      key: where `update_proportion` < 1, draws the (row, feature) entries that count this time.
      update_proportion: the fraction of entries that count (RND: a quarter).
      loss_reduction: over the entries that count.

    >>> one = jnp.ones((2, 3))
    >>> distillation_loss(one, 3 * one, jnp.array([True, False]))
    Array(4., dtype=float32)
    """
    chex.assert_equal_shape([predictor_features, target])
    shape, dtype = predictor_features.shape, predictor_features.dtype
    counted = jnp.broadcast_to(broadcast_mask(valid, predictor_features), shape)
    if update_proportion < 1:
        assert key is not None, "update_proportion < 1 draws entries with a key"
        counted &= jax.random.bernoulli(key, jnp.float32(update_proportion), shape)
    target = lax.stop_gradient(mask_rows(target, valid))
    squared = (mask_rows(predictor_features, valid) - target) ** 2
    total = jnp.sum(jnp.where(counted, squared, jnp.zeros_like(squared)))
    if loss_reduction == "sum":
        return total
    return total / jnp.maximum(jnp.sum(counted, dtype=dtype), 1)


def apply_predictor(
    predictor: Encoder,
    params: Params,
    view: EncoderView,
    frames: Shaped[Array, "B *frame"],
    action: Int[Array, " B"] | None,
) -> Float[Array, "B d"]:
    """Return the predictor's features of a batch of frames.

    Args:
      predictor: the network.
      params: its weights.
      view: how the module sees frames.
      frames: observations.
      action: for predictors that take the action as input (QRND).
    """
    seen = match_dtype(view.preprocess(frames), params)
    return cast(tuple[Array, Array], predictor.apply(params, seen, action))[0]


def distillation(
    predictor: Encoder,
    *,
    reward_reduction: RewardReduction = "mean",
    loss_reduction: LossReduction = "mean",
    update_proportion: Share = 1.0,
) -> Signal:
    """Make the signal of a predictor that copies the encoder: its error at s_t (eq. 4.23).

    With an encoder that stays random this is RND; with one that an objective shapes, SND. The
    encoder is the target: no gradient of this loss reaches it.

    Args:
      predictor: the network that copies.
      reward_reduction: how the reward reduces over features, see `distillation_error`.
      loss_reduction: how the loss reduces, see `distillation_loss`.
      update_proportion: the fraction of entries that count in the loss.

    >>> from sndjax import VECTOR, Encoder
    >>> distillation(Encoder((), VECTOR.hidden, VECTOR.features, gain=1.0))
    distillation(reward_reduction='mean', loss_reduction='mean', update_proportion=1.0)
    """
    check_choice("reward_reduction", reward_reduction, get_args(RewardReduction))
    check_choice("loss_reduction", loss_reduction, get_args(LossReduction))

    def init(
        key: PRNGKeyArray,
        example: Shaped[Array, "N *frame"],
        features: Features,
        num_actions: int,
    ) -> tuple[Params, State]:
        return predictor.init(key, to_float(example[:1]), jnp.zeros(1, jnp.int32)), {}

    def reward(
        params: Params,
        state: State,
        view: EncoderView,
        rollout: Rollout,
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, "T N"], State]:
        def novelty(
            frame: Shaped[Array, "M *frame"], action: Int[Array, " M"]
        ) -> Float[Array, " M"]:
            target, _ = view.encode(frame, action)
            copied = apply_predictor(predictor, params, view, frame, action)
            return distillation_error(copied, target, reward_reduction)

        return map_over_time(novelty, rollout.frames[:-1], rollout.action), state

    def loss(
        params: Params,
        state: State,
        view: EncoderView,
        features: Features,
        batch: Transition,
        key: PRNGKeyArray,
    ) -> Loss:
        copied = apply_predictor(predictor, params, view, batch.frame, batch.action)
        total = distillation_loss(
            copied, features.z, batch.valid, key, update_proportion, loss_reduction
        )
        return total, {"distillation_loss": total}

    settings = {
        "reward_reduction": reward_reduction,
        "loss_reduction": loss_reduction,
        "update_proportion": update_proportion,
    }
    return Signal(init, reward, loss, name="distillation", settings=settings)


def rollout_distillation_error(
    predictor: Encoder,
    params: Params,
    view: EncoderView,
    frames: Shaped[Array, "T1 N *frame"],
    z: Float[Array, "T1 N d"],
    reward_reduction: RewardReduction,
) -> Float[Array, "T1 N"]:
    """Compute the distillation error of every frame of a rollout, whose features are known.

    Args:
      predictor: the network that copies.
      params: its weights.
      view: how the module sees frames.
      frames: s_0 ... s_T.
      z: the encoder's features of them.
      reward_reduction: over features, see `distillation_error`.
    """

    def novelty(frame: Shaped[Array, "M *frame"], z: Float[Array, "M d"]) -> Float[Array, " M"]:
        copied = apply_predictor(predictor, params, view, frame, None)
        return distillation_error(copied, z, reward_reduction)

    return map_over_time(novelty, frames, z)
