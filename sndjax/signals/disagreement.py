"""Disagreement: a transition is novel where the ensemble's predictions disagree."""

from functools import partial

import chex
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray, Shaped

from sndjax.protocols import EncoderView, Signal
from sndjax.ranges import Count, Share
from sndjax.rollout import map_over_time
from sndjax.signals.prediction import (
    encode_rollout,
    init_forward_model,
    predict_next_features,
    prediction_loss,
)
from sndjax.types import Features, Loss, Params, Rollout, State, Transition


def ensemble_variance(predicted: Float[Array, "K B d"]) -> Float[Array, " B"]:
    """Compute the variance over the K members' predictions, mean over d (eq. 4.3).

    >>> ensemble_variance(jnp.array([[[1.0, 0.0]], [[3.0, 0.0]]]))
    Array([0.5], dtype=float32)
    """
    chex.assert_rank(predicted, 3)
    return jnp.mean(jnp.var(predicted, axis=0), axis=-1)


def disagreement(ensemble_size: Count = 5, bootstrap_fraction: Share = 0.5) -> Signal:
    """Make the variance of an ensemble of forward models (eq. 4.3; Pathak et al., 2019).

    Read on (s_t, a_t). Each member sees its own random `bootstrap_fraction` of every minibatch's
    rows; no gradient of its loss reaches the encoder.

    Args:
      ensemble_size: the number of forward models.
      bootstrap_fraction: of a minibatch's rows that each of them sees.

    >>> disagreement()
    disagreement(ensemble_size=5, bootstrap_fraction=0.5)
    """

    def init(
        key: PRNGKeyArray,
        example: Shaped[Array, "N *frame"],
        features: Features,
        num_actions: int,
    ) -> tuple[Params, State]:
        keys = jax.random.split(key, ensemble_size)
        # One after another: a batched orthogonal start would be a batched QR decomposition.
        models = [init_forward_model(k, features.z, num_actions) for k in keys]
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *models), {}

    def reward(
        params: Params,
        state: State,
        view: EncoderView,
        rollout: Rollout,
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, "T N"], State]:
        def variance(z: Float[Array, "M d"], action: Int[Array, " M"]) -> Float[Array, " M"]:
            predict = jax.vmap(predict_next_features, (0, None, None))
            return ensemble_variance(predict(params, z, action))

        z = encode_rollout(view, rollout.frames[:-1])
        return map_over_time(variance, z, rollout.action), state

    def loss(
        params: Params,
        state: State,
        view: EncoderView,
        features: Features,
        batch: Transition,
        key: PRNGKeyArray,
    ) -> Loss:
        z, z_next = lax.stop_gradient(features.z), lax.stop_gradient(features.z_next)
        rows = (ensemble_size, batch.valid.shape[0])
        drawn = jax.random.bernoulli(key, jnp.float32(bootstrap_fraction), rows)
        counted = batch.valid[None] & drawn
        predicted = jax.vmap(predict_next_features, (0, None, None))(params, z, batch.action)
        losses = jax.vmap(partial(prediction_loss, z_next=z_next))(predicted, valid=counted)
        return jnp.sum(losses), {"prediction_loss": jnp.mean(losses)}

    settings = {"ensemble_size": ensemble_size, "bootstrap_fraction": bootstrap_fraction}
    return Signal(init, reward, loss, needs_pairs=True, name="disagreement", settings=settings)
