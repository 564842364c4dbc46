"""Inverse dynamics: which action led from one state to the next (eq. 5.8)."""

from typing import cast

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sndjax.networks import Perceptron
from sndjax.statistics import masked_mean
from sndjax.types import Metrics, Objective


def inverse_dynamics_loss(
    logits: Float[Array, "B A"], action: Int[Array, " B"], valid: Bool[Array, " B"]
) -> tuple[Float[Array, ""], Metrics]:
    """Cross-entropy of the inverse model's logits against the chosen action, over n valid rows::

        L = -1/n sum_i log softmax(logits_i)[a_i]                                 (5.8)

    The equation prints d for n; the published VINV puts probabilities where logits belong.

    >>> loss, _ = inverse_dynamics_loss(jnp.zeros((2, 4)), jnp.array([0, 3]), jnp.ones(2, bool))
    >>> loss.round(4)
    Array(1.3863, dtype=float32)
    """
    chex.assert_rank([logits, action, valid], [2, 1, 1])
    log_p = jnp.take_along_axis(jax.nn.log_softmax(logits), action[:, None], axis=-1)[:, 0]
    right = (jnp.argmax(logits, axis=-1) == action).astype(logits.dtype)
    loss = masked_mean(-log_p, valid)
    return loss, {"inverse_dynamics": loss, "inverse_accuracy": masked_mean(right, valid)}


def inverse_dynamics(last: float = 1.0) -> Objective:
    """An inverse model of 2d -> d -> last * d -> A tells the action from z_t and z_t+1.

    ICM's is `last=1`, SND-VINV's `last=1/2`. See `inverse_dynamics_loss`. Its `init` raises
    ValueError where there are fewer than two actions to tell apart.

    >>> inverse_dynamics()  # doctest: +ELLIPSIS
    Objective(init=...)
    """

    def model_of(z: Array, num_actions: int) -> Perceptron:
        width = z.shape[-1]
        return Perceptron((width, int(last * width), num_actions))

    def init(key, features, num_actions):
        if num_actions < 2:
            raise ValueError(f"inverse dynamics needs at least 2 actions, not {num_actions}")
        both = jnp.concatenate([features.z, features.z_next], axis=-1)
        return model_of(features.z, num_actions).init(key, both)

    def loss(params, encode, features, batch, rollout, key):
        model = model_of(features.z, params["params"]["Dense_2"]["bias"].shape[0])
        both = jnp.concatenate([features.z, features.z_next], axis=-1)
        logits = cast(Array, model.apply(params, both))
        return inverse_dynamics_loss(logits, batch.action, batch.valid)

    return Objective(init, loss)
