"""Bootstrap your own latent on consecutive states (eq. 3.9, 3.10)."""

from typing import NamedTuple, cast

import chex
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sndjax.networks import MLP
from sndjax.protocols import Encode, Objective, TargetNetwork
from sndjax.ranges import Decay
from sndjax.statistics import mask_rows, masked_mean, safe_sqrt
from sndjax.types import Features, Loss, Params, Rollout, Transition


class BYOLParams(NamedTuple):
    """The heads on the encoder."""

    predictor: Params  # d/2 -> d -> d/2
    projector: Params  # d -> d -> d/2


def byol_distance(
    predicted: Float[Array, "B m"], projected: Float[Array, "B m"], valid: Bool[Array, " B"]
) -> Float[Array, ""]:
    """Compute || q/|q| - z'/|z'| ||^2, mean over valid rows (eq. 3.9, summed as Grill et al.).

    That is 2 - 2 cos of the angle between them: 0 when they agree, 4 when they are opposite.
    No gradient reaches z'. A vector of zeros stays one.

    Args:
      predicted: q, of the online network.
      projected: z', of the target network.
      valid: the rows that count.

    >>> one = jnp.ones((1, 2))
    >>> byol_distance(one, -3 * one, jnp.ones(1, bool)).round(4)
    Array(4., dtype=float32)
    """
    chex.assert_equal_shape([predicted, projected])

    def unit(x: Float[Array, "B m"]) -> Float[Array, "B m"]:
        length = safe_sqrt(jnp.sum(x**2, axis=-1, keepdims=True))
        return x / jnp.where(length > 0, length, jnp.ones_like(length))

    predicted, projected = mask_rows(predicted, valid), mask_rows(projected, valid)
    distance = jnp.sum((unit(predicted) - lax.stop_gradient(unit(projected))) ** 2, axis=-1)
    return masked_mean(distance, valid)


def make_heads(z: Float[Array, "B d"]) -> tuple[MLP, MLP]:
    """Return the projector and the predictor for features of this width."""
    width = z.shape[-1]
    return MLP((width, width // 2)), MLP((width, width // 2))


def byol(ema_decay: Decay = 0.99) -> Objective:
    """Make BYOL (eq. 3.10): each state predicts the target network's projection of the other one.

    Projector and predictor are d -> d -> d/2 and d/2 -> d -> d/2, ReLU, without the batch
    normalisation of Grill et al. (2020). Encoder and projector of the target network are moving
    averages, target = ema_decay * target + (1 - ema_decay) * online after each optimizer step.

    Args:
      ema_decay: of the target network's weights.

    >>> byol()
    byol(ema_decay=0.99)
    """

    def init(key: PRNGKeyArray, features: Features, num_actions: int) -> BYOLParams:
        key_projector, key_predictor = jax.random.split(key)
        projector, predictor = make_heads(features.z)
        half = features.z[:, : features.z.shape[-1] // 2]
        return BYOLParams(
            predictor=predictor.init(key_predictor, half),
            projector=projector.init(key_projector, features.z),
        )

    def loss(
        params: BYOLParams,
        encode: Encode,
        features: Features,
        batch: Transition,
        rollout: Rollout,
        key: PRNGKeyArray,
        *,
        target: TargetNetwork,
    ) -> Loss:
        projector, predictor = make_heads(features.z)

        def predict(z: Float[Array, "B d"]) -> Float[Array, "B m"]:
            projected = projector.apply(params.projector, z)
            return cast(Array, predictor.apply(params.predictor, projected))

        z, _ = target.encode(batch.frames)
        projected = cast(Array, projector.apply(target.params.projector, z))
        forth = byol_distance(predict(features.z), batch.at_next(projected), batch.valid)
        back = byol_distance(predict(features.z_next), batch.at_t(projected), batch.valid)
        return forth + back, {"byol_forth": forth, "byol_back": back}

    return Objective(
        init, loss, ema_decay=ema_decay, name="byol", settings={"ema_decay": ema_decay}
    )
