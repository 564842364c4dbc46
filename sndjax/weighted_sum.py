"""Several objectives on one encoder, as SND-VINV's eq. 5.9."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from sndjax.protocols import Encode, Objective
from sndjax.types import Features, Loss, Metrics, Params, Rollout, Transition


def weighted_sum(*parts: tuple[float | int, Objective]) -> Objective:
    """Add objectives, each times its weight.

    Raises:
      ValueError: a part has an `ema_decay`; only a whole objective can.

    >>> from sndjax import inverse_dynamics, vicreg
    >>> vinv = weighted_sum((1, vicreg()), (1 / 2, inverse_dynamics(last=1 / 2)))  # eq. 5.9
    """
    if any(part.ema_decay is not None for _, part in parts):
        raise ValueError("no part of a sum may have an ema_decay")

    def init(key: PRNGKeyArray, features: Features, num_actions: int) -> Params:
        keys = jax.random.split(key, len(parts))
        return [
            part.init(k, features, num_actions) for k, (_, part) in zip(keys, parts, strict=True)
        ]

    def loss(
        params: Params,
        encode: Encode,
        features: Features,
        batch: Transition,
        rollout: Rollout,
        key: PRNGKeyArray,
    ) -> Loss:
        keys = jax.random.split(key, len(parts))
        total = jnp.zeros((), features.z.dtype)
        metrics: Metrics = {}
        for own, k, (weight, part) in zip(params, keys, parts, strict=True):
            own_loss: Callable[..., Loss] = part.loss
            value, terms = own_loss(own, encode, features, batch, rollout, k)
            total = total + weight * value
            metrics |= terms
        return total, metrics

    return Objective(
        init,
        loss,
        needs_pairs=any(part.needs_pairs for _, part in parts),
        name="weighted_sum",
        settings={repr(part): weight for weight, part in parts},
    )
