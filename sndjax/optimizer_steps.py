"""Optimizer steps on minibatches: of a policy, of an intrinsic module."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from sndjax.types import Metrics, Params

ShardRows = Callable[[Any], Any]  # places the rows of a minibatch on devices


def identity(rows: Any) -> Any:
    """Return the rows of a minibatch as they are: all on one device."""
    return rows


def optimizer_step(
    optimizer: optax.GradientTransformation,
    gradient: Params,
    rate: Float[Array, ""] | None,
    carry: tuple[Params, optax.OptState],
) -> tuple[Params, optax.OptState]:
    """Return parameters and optimizer state after a gradient step.

    Args:
      optimizer: what moves them.
      gradient: in the parameters.
      rate: a factor of the learning rate; None: 1.
      carry: parameters and optimizer state before it.
    """
    params, optimizer_state = carry
    updates, optimizer_state = optimizer.update(gradient, optimizer_state, params)
    if rate is not None:
        updates = jax.tree.map(lambda x: rate * x, updates)
    return optax.apply_updates(params, updates), optimizer_state


def annealed_rate(iterations: int, iteration: Int[Array, ""]) -> Float[Array, ""] | None:
    """Compute 1 - iteration / iterations, at least 0: the factor of an annealed learning rate.

    It is the same for all steps of an iteration, as in CleanRL and PureJaxRL.

    Args:
      iterations: over which the learning rate falls to 0; 0: None, it stays.
      iteration: how many were run.

    >>> annealed_rate(4, jnp.int32(1))
    Array(0.75, dtype=float32)
    """
    if not iterations:
        return None
    return jnp.maximum(1 - iteration.astype(jnp.float32) / iterations, 0)


def step_with_rows(step: Callable[[Any], Any], carry: Any, valid: Bool[Array, " B"]) -> Any:
    """Take an optimizer step, or none if no row of its minibatch is valid.

    The gradient is zero then, but Adam would still move the weights, by its momentum.

    Args:
      step: the optimizer step.
      carry: the pytree that it moves.
      valid: the rows that count.
    """
    return lax.cond(jnp.any(valid), step, lambda carry: carry, carry)


def mean_metrics(metrics: dict[str, Array]) -> Metrics:
    """Average every metric over minibatches."""
    return {name: jnp.mean(value) for name, value in metrics.items()}
