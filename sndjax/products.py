"""Matrix products at jax's default matmul precision, on every device.

A program traced under `jax.default_matmul_precision("BF16_BF16_F32")`, or with TF32, multiplies
with operands of fewer bits on an accelerator. A CPU would ignore the setting, so here the operands
are rounded before the product, and the gradient too: what a GPU would compute, up to the order of
summation, can be tried and tested anywhere. ("bfloat16" and "tensorfloat32" mean the same here; on
a GPU they are jax's words for its fastest and its next precision.) Without a setting a product is
`lax.dot_general`, and nothing is rounded.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

EXACT = lax.Precision.HIGHEST  # of sums that cancel: distances, inverse matrices
# Bits of the mantissa that each name of a precision keeps, in jax's words.
MANTISSA = {
    "tensorfloat32": 10,
    "TF32_TF32_F32": 10,
    "bfloat16": 7,
    "BF16_BF16_F32": 7,
}


def mantissa_bits() -> int | None:
    """Return the bits that are to be kept of operands on a CPU; None: all, or another device."""
    name = "jax_default_matmul_precision"  # jax declares no such attribute
    return MANTISSA.get(str(getattr(jax.config, name))) if jax.default_backend() == "cpu" else None


def round_mantissa(x: Float[Array, "*shape"], bits: int) -> Float[Array, "*shape"]:
    """Round float32 numbers to the nearest with so many bits of mantissa; others stay.

    Args:
      x: the numbers.
      bits: of the mantissa: 10 of TF32, 7 of bfloat16.

    >>> round_mantissa(jnp.float32(1 + 2**-8), 7), round_mantissa(jnp.float32(1 + 2**-7), 7)
    (Array(1., dtype=float32), Array(1.0078125, dtype=float32))
    """
    return lax.reduce_precision(x, 8, bits) if x.dtype == jnp.float32 else x


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def rounded_product(left: Array, right: Array, dimensions: Any, bits: int) -> Array:
    """Multiply rounded operands, and in the gradient rounded ones too.

    Args:
      left: the left operand.
      right: the right operand.
      dimensions: see `lax.dot_general`.
      bits: of the mantissa.
    """
    return rounded_product_forward(left, right, dimensions, bits)[0]


def rounded_product_forward(
    left: Array, right: Array, dimensions: Any, bits: int
) -> tuple[Array, Any]:
    """Multiply, and keep the rounded operands' transposed products.

    Args:
      left: the left operand.
      right: the right operand.
      dimensions: see `lax.dot_general`.
      bits: of the mantissa.
    """
    operands = round_mantissa(left, bits), round_mantissa(right, bits)
    return jax.vjp(partial(lax.dot_general, dimension_numbers=dimensions), *operands)


def rounded_product_backward(
    dimensions: Any, bits: int, transposed: Any, gradient: Array
) -> tuple[Array, Array]:
    """Compute the gradients in both operands.

    Args:
      dimensions: see `lax.dot_general`.
      bits: of the mantissa.
      transposed: kept by the forward pass.
      gradient: of the product.
    """
    return transposed(round_mantissa(gradient, bits))


rounded_product.defvjp(rounded_product_forward, rounded_product_backward)


def dot_general(
    left: Array,
    right: Array,
    dimension_numbers: Any,
    precision: Any = None,
    preferred_element_type: Any = None,
) -> Array:
    """Multiply as `lax.dot_general` does, at jax's default matmul precision on a CPU too.

    Args:
      left: the left operand.
      right: the right operand.
      dimension_numbers: see `lax.dot_general`.
      precision: as there; if given, nothing is rounded here.
      preferred_element_type: as there.
    """
    bits = mantissa_bits()
    if bits is None or precision is not None:
        return lax.dot_general(
            left,
            right,
            dimension_numbers,
            precision=precision,
            preferred_element_type=preferred_element_type,
        )
    return rounded_product(left, right, dimension_numbers, bits)


def matmul(left: Float[Array, "*rows n"], right: Float[Array, "n m"]) -> Float[Array, "*rows m"]:
    """Compute `left @ right` of a matrix or a stack of rows and a matrix.

    Args:
      left: rows.
      right: a matrix.

    >>> third = jnp.full((1, 1), 1 / 3)
    >>> with jax.default_matmul_precision("bfloat16"):
    ...     rough = matmul(third, jnp.ones((1, 1)))
    >>> matmul(third, jnp.ones((1, 1))).item(), rough.item()
    (0.3333333432674408, 0.333984375)
    """
    return dot_general(left, right, (((left.ndim - 1,), (0,)), ((), ())))
