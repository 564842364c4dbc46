"""Skip updates that produce NaN or Inf."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sndjax.types import Experience, Metrics, TrainState

TrainStep = Callable[[TrainState, Experience], tuple[TrainState, Metrics, Float[Array, "T N"]]]


def all_finite(tree: Any) -> Bool[Array, ""]:
    """Return whether every floating-point number of a pytree is finite.

    >>> all_finite({"a": jnp.ones(2), "n": jnp.arange(3)}), all_finite([jnp.array(jnp.nan)])
    (Array(True, dtype=bool), Array(False, dtype=bool))
    """
    numbers = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.inexact)]
    return jnp.stack([jnp.all(jnp.isfinite(x)) for x in (*numbers, jnp.zeros(()))]).all()


def skip_nonfinite(train_step: TrainStep) -> TrainStep:
    """Wrap `train_step`: a state that would not be finite afterwards stays as it was.

    Only its key and its count of iterations move. The metrics gain `skipped`, 1 or 0, and
    keep what was not finite; intrinsic rewards that were not are 0. Costs the memory of a
    second state.
    """

    def guarded(
        state: TrainState, batch: Experience
    ) -> tuple[TrainState, Metrics, Float[Array, "T N"]]:
        new, metrics, reward = train_step(state, batch)
        fine = all_finite((new._replace(key=jnp.zeros(())), metrics))
        kept = jax.tree.map(lambda new, old: jnp.where(fine, new, old), new, state)
        reward = jnp.where(jnp.isfinite(reward), reward, jnp.zeros_like(reward))
        skipped = jnp.where(fine, 0.0, 1.0)
        return (
            kept._replace(key=new.key, iteration=new.iteration),
            metrics | {"skipped": skipped},
            reward,
        )

    return guarded
