"""Bootstrap your own latent on consecutive states (eq. 3.9, 3.10)."""

from typing import cast

import chex
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from sndjax.networks import Perceptron
from sndjax.statistics import masked_mean, safe_sqrt
from sndjax.types import Objective


def byol_distance(
    predicted: Float[Array, "B m"], projected: Float[Array, "B m"], valid: Bool[Array, " B"]
) -> Float[Array, ""]:
    """|| q/|q| - z'/|z'| ||^2, mean over valid rows (eq. 3.9, its MSE as Grill et al. sum it).

    That is 2 - 2 cos of the angle between them: 0 when they agree, 4 when they are opposite.
    No gradient reaches z'. A vector of zeros stays one.

    >>> one = jnp.ones((1, 2))
    >>> byol_distance(one, -3 * one, jnp.ones(1, bool)).round(4)
    Array(4., dtype=float32)
    """
    chex.assert_equal_shape([predicted, projected])

    def unit(x):
        length = safe_sqrt(jnp.sum(x**2, axis=-1, keepdims=True))
        return x / jnp.where(length > 0, length, jnp.ones_like(length))

    distance = jnp.sum((unit(predicted) - lax.stop_gradient(unit(projected))) ** 2, axis=-1)
    return masked_mean(distance, valid)


def byol(decay: float = 0.99) -> Objective:
    """BYOL (eq. 3.10): each state predicts the averaged network's view of the other one.

    Projector and predictor are d -> d -> d/2 and d/2 -> d -> d/2, ReLU, without the batch
    normalisation of Grill et al. (2020). Encoder and projector of the target network are
    moving averages, slow = decay * slow + (1 - decay) * now after each optimizer step.

    >>> byol().decay
    0.99
    """

    def heads(z: Array) -> tuple[Perceptron, Perceptron]:
        width = z.shape[-1]
        return Perceptron((width, width // 2)), Perceptron((width, width // 2))

    def init(key, features, num_actions):
        key_projector, key_predictor = jax.random.split(key)
        projector, predictor = heads(features.z)
        half = features.z[:, : features.z.shape[-1] // 2]
        return {
            "projector": projector.init(key_projector, features.z),
            "predictor": predictor.init(key_predictor, half),
        }

    def loss(params, encode, features, batch, rollout, key, average):
        projector, predictor = heads(features.z)

        def online(z) -> Array:
            projected = projector.apply(params["projector"], z)
            return cast(Array, predictor.apply(params["predictor"], projected))

        z, _ = average.encode(batch.frames)
        slow = cast(Array, projector.apply(average.params["projector"], z))
        forth = byol_distance(online(features.z), batch.then(slow), batch.valid)
        back = byol_distance(online(features.z_next), batch.now(slow), batch.valid)
        return forth + back, {"byol_forth": forth, "byol_back": back}

    return Objective(init, loss, decay=decay)
