"""The times of a convolution's implementations in one gradient of the policy's network."""

import time
from collections.abc import Callable
from typing import Any, cast
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np

from sndjax import ATARI, ActorCritic, convolution, networks

from ..system.versions import versions
from ..training.flops import count_flops
from .timing import BenchmarkTimer, device_name, print_line

BATCH, AGENTS = 512, 4
SLICES = {f"slices of {images}": BATCH // images for images in (4, 8, 16, 64)}
Variant = tuple[int, str]  # agents at once, and the implementation
WHOLE, NATIVE = "the batch in one slice", "XLA's own convolution"


def convolution_variant(name: str) -> Any:
    """Return a context in which networks use this implementation."""
    if name == NATIVE:
        return patch.object(networks, "convolve", convolution.convolve_native)
    return patch.object(convolution, "slice_count", lambda images: SLICES.get(name, 1))


def policy_gradient() -> tuple[Callable[..., Any], tuple[Any, jax.Array]]:
    """Return a loss of the policy's network, and its parameters with a batch of stacks."""
    network = ActorCritic(ATARI, 18)
    draw = np.random.default_rng(0)
    stacks = jnp.asarray(draw.integers(0, 256, (BATCH, 96, 96, 4), np.uint8))
    params = network.init(jax.random.key(0), stacks[:1])

    def loss(params: Any, stacks: jax.Array) -> jax.Array:
        logits, value = cast(tuple[jax.Array, jax.Array], network.apply(params, stacks))
        return jnp.sum(logits**2) + jnp.sum(value**2)

    return loss, (params, stacks)


def compile_variants(loss: Callable[..., Any], inputs: dict[int, Any]) -> dict[Variant, Any]:
    """Compile the gradient of a loss with every implementation.

    Args:
      loss: the loss of one agent.
      inputs: the arguments of the loss, by the number of agents.
    """
    names = [WHOLE, NATIVE] if len(inputs) > 1 else [*SLICES, WHOLE, NATIVE]
    compiled = {}
    for count, name in [(count, name) for count in inputs for name in names]:
        print_line(f"compiling: {name}, {count} agent(s)")
        # A new function for each variant: jax would reuse the program of the previous one.
        gradient = jax.grad(lambda params, stacks: loss(params, stacks))
        with convolution_variant(name):
            step = jax.jit(gradient if count == 1 else jax.vmap(gradient))
            compiled[count, name] = step.lower(*inputs[count]).compile()
        jax.block_until_ready(compiled[count, name](*inputs[count]))
    return compiled


def time_variants(
    compiled: dict[Variant, Any], inputs: dict[int, Any], rounds: int, timer: BenchmarkTimer
) -> dict[Variant, list[float]]:
    """Time all variants in turn, in another order each round, after a matrix product.

    Args:
      compiled: the compiled variants.
      inputs: their arguments, by the number of agents.
      rounds: the number of times that each variant is timed.
      timer: the timer of the matrix product.

    Returns:
      The seconds of every round, by variant.
    """
    draw = np.random.default_rng(0)
    times: dict[Variant, list[float]] = {variant: [] for variant in compiled}
    for turn in range(rounds):
        print_line(f"round {turn + 1} of {rounds}")
        timer.time_product()
        for index in draw.permutation(len(times)):
            variant = list(times)[index]
            begun = time.perf_counter()
            jax.block_until_ready(compiled[variant](*inputs[variant[0]]))
            times[variant].append(time.perf_counter() - begun)
    return times


def print_convolutions(rounds: int) -> None:
    """Time every implementation, and print a line for each."""
    loss, alone = policy_gradient()
    work = count_flops(jax.make_jaxpr(jax.grad(loss))(*alone).jaxpr)
    inputs = {1: alone}
    if jax.default_backend() != "cpu":
        inputs[AGENTS] = jax.tree.map(lambda x: jnp.stack([x] * AGENTS), alone)
    compiled = compile_variants(loss, inputs)
    timer = BenchmarkTimer()
    times = time_variants(compiled, inputs, rounds, timer)
    rate = timer.gflops()
    print_line(
        f"{'':<26}{'agents':>8}{'best ms':>10}{'median ms':>11}{'of the product':>16}"
        f"{'temporaries MB':>16}"
    )
    for (count, name), found in times.items():
        memory = compiled[count, name].memory_analysis().temp_size_in_bytes / 1e6
        share = count * work / np.median(found) / 1e9 / rate
        print_line(
            f"{name:<26}{count:>8}{1e3 * min(found):>10.1f}{1e3 * np.median(found):>11.1f}"
            f"{share:>16.2f}{memory:>16,.0f}"
        )
    print_line(f"{device_name()}; product {rate:.0f} GFLOP/s; {versions()}")
