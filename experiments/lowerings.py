"""python -m experiments.lowerings: a convolution's ways down to the processor, timed side by side.

One gradient of the policy's network on 512 Atari stacks: as `sndjax.convolution` builds it, with
slices of other sizes, and with XLA's own convolution. All in turn, each round in another order, a
matrix product before each round. For whoever wants to know whether eight images a slice suit
another machine too.
"""

import time
from typing import Any, cast
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np

from experiments.estimate import operations
from experiments.process import before_jax
from experiments.timing import Clock, processor, say
from experiments.versions import versions
from sndjax import ATARI, ActorCritic, convolution

BATCH, ROUNDS = 512, 8
VARIANTS: dict[str, dict[str, Any]] = {
    "as built": {},
    "slices of 4": {"SLICE": 4},
    "slices of 16": {"SLICE": 16},
    "slices of 64": {"SLICE": 64},
    "the batch in one slice": {"SLICE": BATCH},
    "XLA's own convolution": {"convolve_patches": convolution.convolve_native},
}


def main() -> None:
    """Print a line a variant."""
    network = ActorCritic(ATARI, 18)
    draw = np.random.default_rng(0)
    stacks = jnp.asarray(draw.integers(0, 256, (BATCH, 96, 96, 4), np.uint8))
    params = network.init(jax.random.key(0), stacks[:1])

    def loss(params: Any, stacks: jax.Array) -> jax.Array:
        logits, value = cast(tuple[jax.Array, jax.Array], network.apply(params, stacks))
        return jnp.sum(logits**2) + jnp.sum(value**2)

    work = operations(jax.make_jaxpr(jax.grad(loss))(params, stacks).jaxpr)
    compiled: dict[str, Any] = {}
    times: dict[str, list[float]] = {name: [] for name in VARIANTS}
    clock = Clock()
    for name, constants in VARIANTS.items():
        say(f"compiling: {name}")
        with patch.multiple(convolution, **{"SLICE": convolution.SLICE} | constants):
            # A function of its own, or jax would take the program of the variant before.
            step = jax.jit(jax.grad(lambda params, stacks: loss(params, stacks)))
            compiled[name] = step.lower(params, stacks).compile()
        jax.block_until_ready(compiled[name](params, stacks))
    for turn in range(ROUNDS):
        say(f"round {turn + 1} of {ROUNDS}")
        clock.time_product()
        for name in draw.permutation(list(VARIANTS)):
            begun = time.perf_counter()
            jax.block_until_ready(compiled[name](params, stacks))
            times[name].append(time.perf_counter() - begun)
    rate = clock.gflops()
    say(f"{'':<26}{'best ms':>9}{'median ms':>11}{'of the product':>16}{'temporaries MB':>16}")
    for name, found in times.items():
        memory = compiled[name].memory_analysis().temp_size_in_bytes / 1e6
        share = work / np.median(found) / 1e9 / rate
        say(
            f"{name:<26}{1e3 * min(found):>9.0f}{1e3 * np.median(found):>11.0f}{share:>16.2f}"
            f"{memory:>16,.0f}"
        )
    say(f"{processor()}; product {rate:.0f} GFLOP/s; {versions()}")


if __name__ == "__main__":
    before_jax()
    main()
