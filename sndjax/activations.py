"""The activations that networks may have, with their slopes."""

from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array

Activation = Literal["elu", "relu", "leaky_relu", "tanh", "none"]
ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "elu": jax.nn.elu,
    "relu": jax.nn.relu,
    "leaky_relu": jax.nn.leaky_relu,
    "tanh": jnp.tanh,
    "none": lambda x: x,
}
# The slope of each as a function of its output.
SLOPES: dict[str, Callable[[Array], Array]] = {
    "elu": lambda y: jnp.where(y > 0, jnp.ones_like(y), y + 1),
    "relu": lambda y: (y > 0).astype(y.dtype),
    "leaky_relu": lambda y: jnp.where(y > 0, jnp.ones_like(y), 0.01),
    "tanh": lambda y: 1 - y**2,
    "none": jnp.ones_like,
}
