"""Forward prediction: the novelty of a transition is the error of a forward model."""

from functools import partial
from typing import Literal, cast, get_args

import chex
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from sndjax.checks import check_choice
from sndjax.networks import MLP, mlp_widths
from sndjax.protocols import EncoderView, Signal
from sndjax.rollout import map_over_time
from sndjax.statistics import mask_rows, masked_mean
from sndjax.types import Features, Loss, Params, Rollout, State, Transition

Gradient = Literal["symmetric", "detached", "asymmetric"]
PredictionReduction = Literal["tanh_mean", "mean", "half_sum"]


def prediction_error(
    predicted: Float[Array, "*rows d"],
    z_next: Float[Array, "*rows d"],
    reward_reduction: PredictionReduction = "tanh_mean",
) -> Float[Array, "*rows"]:
    """Compute the novelty of each transition from the squares (predicted - z_next)^2.

    Args:
      predicted: features of s_t+1, of the forward model.
      z_next: features of s_t+1, of the encoder.
      reward_reduction: "tanh_mean", tanh of the mean over d, as the published experiments; "mean";
        "half_sum", half the sum over d, is ICM's (Pathak et al., 2017) and, but for the half, that
        of eq. 4.2 and 5.10.

    >>> prediction_error(jnp.array([[1.0, 0.0]]), jnp.zeros((1, 2))).round(4)
    Array([0.4621], dtype=float32)
    """
    chex.assert_equal_shape([predicted, z_next])
    squared = (predicted - z_next) ** 2
    if reward_reduction == "half_sum":
        return jnp.sum(squared, axis=-1) / 2
    mean = jnp.mean(squared, axis=-1)
    return jnp.tanh(mean) if reward_reduction == "tanh_mean" else mean


def prediction_loss(
    predicted: Float[Array, "B d"], z_next: Float[Array, "B d"], valid: Bool[Array, " B"]
) -> Float[Array, ""]:
    """Compute the squared error of the forward model (eq. 5.11), mean over valid rows and d.

    Args:
      predicted: features of s_t+1, of the forward model.
      z_next: features of s_t+1, of the encoder.
      valid: the rows that count.

    >>> one = jnp.ones((2, 3))
    >>> prediction_loss(one, 3 * one, jnp.array([True, False]))
    Array(4., dtype=float32)
    """
    chex.assert_equal_shape([predicted, z_next])
    predicted, z_next = mask_rows(predicted, valid), mask_rows(z_next, valid)
    return masked_mean(jnp.mean((predicted - z_next) ** 2, axis=-1), valid)


def forward_model(z: Float[Array, "B d"]) -> MLP:
    """Return the forward model for features of this width: d + A -> d -> d -> d."""
    return MLP((z.shape[-1],) * 3)


def init_forward_model(key: PRNGKeyArray, z: Float[Array, "B d"], num_actions: int) -> Params:
    """Return the weights of a forward model before any training.

    Args:
      key: of the random draws.
      z: features, for their width.
      num_actions: A.
    """
    return forward_model(z).init(key, jnp.zeros((1, z.shape[-1] + num_actions), z.dtype))


def predict_next_features(
    params: Params, z: Float[Array, "B d"], action: Int[Array, " B"]
) -> Float[Array, "B d"]:
    """Return the forward model's features of s_t+1.

    Args:
      params: of the forward model.
      z: features of s_t.
      action: a_t; the model reads it one-hot.
    """
    num_actions = mlp_widths(params)[0] - z.shape[-1]
    one_hot = jax.nn.one_hot(action, num_actions, dtype=z.dtype)
    return cast(Array, forward_model(z).apply(params, jnp.concatenate([z, one_hot], axis=-1)))


def encode_rollout(
    view: EncoderView, frames: Shaped[Array, "T1 N *frame"]
) -> Float[Array, "T1 N d"]:
    """Return the features of every frame of a rollout, s_T included."""
    return map_over_time(lambda frame: view.encode(frame)[0], frames)


def prediction(
    *, gradient: Gradient = "symmetric", reward_reduction: PredictionReduction = "tanh_mean"
) -> Signal:
    """Make the signal of a forward model of d + A -> d -> d -> d: its error at (s_t, a_t, s_t+1).

    s_t+1 is the true one, at an episode's end too.

    Args:
      gradient: of the forward loss into the encoder. `symmetric`: through z_t and z_t+1, as
        the published SP; `detached`: through z_t alone, as ICM; `asymmetric`: none (5.1.4).
      reward_reduction: how the reward reduces over features, see `prediction_error`.

    >>> prediction(gradient="asymmetric")
    prediction(gradient='asymmetric', reward_reduction='tanh_mean')
    """
    check_choice("gradient", gradient, get_args(Gradient))
    check_choice("reward_reduction", reward_reduction, get_args(PredictionReduction))

    def init(
        key: PRNGKeyArray,
        example: Shaped[Array, "N *frame"],
        features: Features,
        num_actions: int,
    ) -> tuple[Params, State]:
        return init_forward_model(key, features.z, num_actions), {}

    def reward(
        params: Params,
        state: State,
        view: EncoderView,
        rollout: Rollout,
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, "T N"], State]:
        z = encode_rollout(view, rollout.frames)
        predicted = map_over_time(partial(predict_next_features, params), z[:-1], rollout.action)
        return prediction_error(predicted, z[1:], reward_reduction), state

    def loss(
        params: Params,
        state: State,
        view: EncoderView,
        features: Features,
        batch: Transition,
        key: PRNGKeyArray,
    ) -> Loss:
        z, z_next = features.z, features.z_next
        z = lax.stop_gradient(z) if gradient == "asymmetric" else z
        z_next = z_next if gradient == "symmetric" else lax.stop_gradient(z_next)
        predicted = predict_next_features(params, z, batch.action)
        total = prediction_loss(predicted, z_next, batch.valid)
        return total, {"prediction_loss": total}

    return Signal(
        init,
        reward,
        loss,
        needs_pairs=True,
        name="prediction",
        settings={"gradient": gradient, "reward_reduction": reward_reduction},
    )
