"""Disagreement: a transition is novel where an ensemble of forward models has no one opinion."""

from functools import partial

import chex
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from sndjax.rollout import map_steps
from sndjax.signals.prediction import features_of_all, foresee, init_forward_model, prediction_loss
from sndjax.types import Params, Signal


def ensemble_variance(predicted: Float[Array, "K B d"]) -> Float[Array, " B"]:
    """Variance over the K members' predictions, mean over d (eq. 4.3).

    >>> ensemble_variance(jnp.array([[[1.0, 0.0]], [[3.0, 0.0]]]))
    Array([0.5], dtype=float32)
    """
    chex.assert_rank(predicted, 3)
    return jnp.mean(jnp.var(predicted, axis=0), axis=-1)


def disagreement(members: int = 5, share: float = 0.5) -> Signal:
    """The variance of an ensemble of forward models (eq. 4.3; Pathak et al., 2019).

    Read on (s_t, a_t). Each member sees its own random `share` of every minibatch's rows; no
    gradient of its loss reaches the encoder.

    >>> disagreement()  # doctest: +ELLIPSIS
    Signal(init=...)
    """

    def init(key, example, features, num_actions) -> tuple[Params, dict]:
        keys = jax.random.split(key, members)
        # One after another: a batched orthogonal start would be a batched QR decomposition.
        models = [init_forward_model(k, features.z, num_actions) for k in keys]
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *models), {}

    def reward(params, state, view, rollout, key):
        def variance(z, action):
            return ensemble_variance(jax.vmap(foresee, (0, None, None))(params, z, action))

        z = features_of_all(view, rollout.frames[:-1])
        return map_steps(variance, z, rollout.action), state

    def loss(params, state, view, features, batch, key):
        z, z_next = lax.stop_gradient(features.z), lax.stop_gradient(features.z_next)
        rows = (members, batch.valid.shape[0])
        counted = batch.valid[None] & jax.random.bernoulli(key, jnp.float32(share), rows)
        predicted = jax.vmap(foresee, (0, None, None))(params, z, batch.action)
        losses = jax.vmap(partial(prediction_loss, z_next=z_next))(predicted, valid=counted)
        return jnp.sum(losses), {"prediction_loss": jnp.mean(losses)}

    return Signal(init, reward, loss, pairs=True)
