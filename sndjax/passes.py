"""Passes over minibatches: one optimizer step after another, all at once or slice by slice."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int


class Pass(NamedTuple):
    """M optimizer steps on M minibatches.

    Attributes:
      step: (carry, input) -> (carry, metrics), one optimizer step.
      start: the carry before the first step.
      inputs: of each step, leaves [M, ...].
    """

    step: Callable[[Any, Any], tuple[Any, dict[str, Array]]]
    start: Any
    inputs: Any


class PassState(NamedTuple):
    """A pass of which some steps were taken."""

    carry: Any  # after them
    metrics: dict[str, Array]  # [M]; 0 for steps that were not taken yet


def count_steps(inputs: Any, axis: int = 0) -> int:
    """Return M, the number of steps of a pass with these inputs.

    Args:
      inputs: of its steps.
      axis: the axis of the steps; 1 for inputs of several seeds.
    """
    return int(jax.tree.leaves(inputs)[0].shape[axis])


def run_pass(whole: Pass) -> PassState:
    """Take all steps of a pass.

    >>> add = lambda carry, x: (carry + x, {"sum": carry + x})
    >>> run_pass(Pass(add, jnp.zeros(()), jnp.arange(3.0)))
    PassState(carry=Array(3., dtype=float32), metrics={'sum': Array([0., 1., 3.], dtype=float32)})
    """
    return PassState(*lax.scan(whole.step, whole.start, whole.inputs))


def start_pass(whole: Pass) -> PassState:
    """Return a pass of which no step was taken."""
    one = jax.tree.map(lambda x: x[0], whole.inputs)
    _, shapes = jax.eval_shape(whole.step, whole.start, one)
    steps = count_steps(whole.inputs)
    zeros = jax.tree.map(lambda x: jnp.zeros((steps, *x.shape), x.dtype), shapes)
    return PassState(whole.start, zeros)


def run_slice(
    whole: Pass, state: PassState, first: Int[Array, ""], end: Int[Array, ""]
) -> PassState:
    """Take the steps `first` to `end - 1` of a pass: slice after slice, the same as `run_pass`.

    Both numbers may be traced, so that one compiled program takes slices of any length.

    Args:
      whole: the pass; its `start` is not read.
      state: after the steps before `first`.
      first: the first step.
      end: the step after the last one.

    >>> add = lambda carry, x: (carry + x, {"sum": carry + x})
    >>> whole = Pass(add, jnp.zeros(()), jnp.arange(3.0))
    >>> some = run_slice(whole, start_pass(whole), jnp.int32(0), jnp.int32(2))
    >>> run_slice(whole, some, jnp.int32(2), jnp.int32(3)).metrics["sum"]
    Array([0., 1., 3.], dtype=float32)
    """

    def step(i: Int[Array, ""], state: PassState) -> PassState:
        carry, metrics = whole.step(state.carry, jax.tree.map(lambda x: x[i], whole.inputs))
        rows = jax.tree.map(lambda row, new: row.at[i].set(new), state.metrics, metrics)
        return PassState(carry, rows)

    return lax.fori_loop(first, end, step, state)
