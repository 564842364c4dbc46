"""Several objectives on one encoder, as SND-VINV's eq. 5.9."""

import jax
import jax.numpy as jnp

from sndjax.types import Metrics, Objective


def weighted_sum(*parts: tuple[float | int, Objective]) -> Objective:
    """The sum of objectives, each times its weight.

    Raises:
      ValueError: a part keeps a moving average; only a whole objective can.

    >>> from sndjax import inverse_dynamics, vicreg
    >>> vinv = weighted_sum((1, vicreg()), (1 / 2, inverse_dynamics(last=1 / 2)))  # eq. 5.9
    """
    if any(part.decay is not None for _, part in parts):
        raise ValueError("no part of a sum may keep a moving average")

    def init(key, features, num_actions):
        keys = jax.random.split(key, len(parts))
        return [
            part.init(k, features, num_actions) for k, (_, part) in zip(keys, parts, strict=True)
        ]

    def loss(params, encode, features, batch, rollout, key):
        keys = jax.random.split(key, len(parts))
        total = jnp.zeros((), features.z.dtype)
        metrics: Metrics = {}
        for own, k, (weight, part) in zip(params, keys, parts, strict=True):
            value, terms = part.loss(own, encode, features, batch, rollout, k)
            total = total + weight * value
            metrics |= terms
        return total, metrics

    return Objective(init, loss, any(part.pairs for _, part in parts))
