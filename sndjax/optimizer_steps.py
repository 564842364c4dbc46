"""Optimizer steps on minibatches: of a policy, of an intrinsic module."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Bool

from sndjax.types import Metrics, Params

ShardRows = Callable[[Any], Any]  # places the rows of a minibatch on devices


def identity(rows: Any) -> Any:
    """Return the rows of a minibatch as they are: all on one device."""
    return rows


def optimizer_step(
    optimizer: optax.GradientTransformation,
    gradient: Params,
    carry: tuple[Params, optax.OptState],
) -> tuple[Params, optax.OptState]:
    """Return parameters and optimizer state after a gradient step.

    Args:
      optimizer: what moves them.
      gradient: in the parameters.
      carry: parameters and optimizer state before it.
    """
    params, optimizer_state = carry
    updates, optimizer_state = optimizer.update(gradient, optimizer_state, params)
    return optax.apply_updates(params, updates), optimizer_state


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
