"""An estimate of the time of an update, for the first one, before any has been timed."""

import math
import time
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr

SHARE_OF_PEAK = 0.45  # the speed of a typical update relative to a plain matrix product


def count_flops(jaxpr: Jaxpr) -> float:
    """Count the floating-point operations of the products and convolutions in a program.

    The body of a loop counts once for each iteration (of a `while` of unknown length, only once).

    >>> from jax import lax
    >>> a = jnp.ones((10, 10))
    >>> program = jax.make_jaxpr(lambda a: lax.scan(lambda x, _: (x @ a, None), a, length=3)[0])
    >>> count_flops(program(a).jaxpr)
    6000.0
    """
    total = 0.0
    for equation in jaxpr.eqns:
        size = math.prod(shape_of(equation.outvars[0])) if equation.outvars else 0
        if equation.primitive.name == "dot_general":
            contracted = equation.params["dimension_numbers"][0][0]
            shape = shape_of(equation.invars[0])
            total += 2.0 * size * math.prod(shape[axis] for axis in contracted)
        elif equation.primitive.name == "conv_general_dilated":
            kernel = shape_of(equation.invars[1])
            out = equation.params["dimension_numbers"].rhs_spec[0]
            total += 2.0 * size * math.prod(kernel) / kernel[out]
        times = equation.params.get("length", 1) if equation.primitive.name == "scan" else 1
        total += times * sum(count_flops(inner) for inner in inner_jaxprs(equation.params.values()))
    return total


def shape_of(variable: Any) -> tuple[int, ...]:
    """Return the shape of an operand or a result; () for a token, which has no shape."""
    return getattr(variable.aval, "shape", ())


def inner_jaxprs(values: Any) -> list[Jaxpr]:
    """Return the programs among an operation's parameters: bodies of loops, branches, calls."""
    found = []
    for value in values:
        if isinstance(value, ClosedJaxpr):
            found.append(value.jaxpr)
        elif isinstance(value, Jaxpr):
            found.append(value)
        elif isinstance(value, (tuple, list)):
            found += inner_jaxprs(value)
    return found


def matmul_flops_per_second(size: int = 2048) -> float:
    """Measure the floating-point operations per second of a float32 matrix product."""
    product = jax.jit(lambda a: a @ a)
    a = jnp.ones((size, size))
    product(a).block_until_ready()
    begun = time.monotonic()
    product(a).block_until_ready()
    return 2 * size**3 / (time.monotonic() - begun)


def estimate_seconds(jaxpr: Jaxpr) -> float:
    """Estimate the seconds of one run of a program in which products take most of the time."""
    return count_flops(jaxpr) / (SHARE_OF_PEAK * matmul_flops_per_second())
