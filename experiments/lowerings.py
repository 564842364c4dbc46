"""python -m experiments.lowerings: a convolution's ways down to the processor, timed side by side.

One gradient of the policy's network on 512 Atari stacks: in slices of several sizes (on a CPU
`sndjax.convolution` takes eight images, elsewhere the whole batch) and with XLA's own
convolution. On a GPU, where many small slices compile slowly, only the whole batch and XLA's own,
but of four agents at once too. All in turn, each round in another order, a matrix product before
each round. For whoever wants to know whether what was chosen suits another machine.
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
from sndjax import ATARI, ActorCritic, convolution, networks

BATCH, ROUNDS, AGENTS = 512, 8, 4
SLICES = {f"slices of {images}": BATCH // images for images in (4, 8, 16, 64)}
WHOLE, NATIVE = "the batch in one slice", "XLA's own convolution"


def lowered(name: str) -> Any:
    """A context in which networks are made with this variant."""
    if name == NATIVE:
        return patch.object(networks, "convolve", convolution.convolve_native)
    return patch.object(convolution, "slice_count", lambda images: SLICES.get(name, 1))


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
    alone = (params, stacks)
    together = jax.tree.map(lambda x: jnp.stack([x] * AGENTS), alone)
    names, inputs = [*SLICES, WHOLE, NATIVE], {1: alone}
    if jax.default_backend() != "cpu":
        names, inputs = [WHOLE, NATIVE], {1: alone, AGENTS: together}
    compiled: dict[tuple[int, str], Any] = {}
    times: dict[tuple[int, str], list[float]] = {}
    clock = Clock()
    for count, name in [(count, name) for count in inputs for name in names]:
        say(f"compiling: {name}, {count} agent(s)")
        # A function of its own, or jax would take the program of the variant before.
        gradient = jax.grad(lambda params, stacks: loss(params, stacks))
        with lowered(name):
            step = jax.jit(gradient if count == 1 else jax.vmap(gradient))
            compiled[count, name] = step.lower(*inputs[count]).compile()
        jax.block_until_ready(compiled[count, name](*inputs[count]))
        times[count, name] = []
    for turn in range(ROUNDS):
        say(f"round {turn + 1} of {ROUNDS}")
        clock.time_product()
        for index in draw.permutation(len(times)):
            count, name = list(times)[index]
            begun = time.perf_counter()
            jax.block_until_ready(compiled[count, name](*inputs[count]))
            times[count, name].append(time.perf_counter() - begun)
    rate = clock.gflops()
    say(
        f"{'':<26}{'agents':>8}{'best ms':>10}{'median ms':>11}{'of the product':>16}"
        f"{'temporaries MB':>16}"
    )
    for (count, name), found in times.items():
        memory = compiled[count, name].memory_analysis().temp_size_in_bytes / 1e6
        share = count * work / np.median(found) / 1e9 / rate
        say(
            f"{name:<26}{count:>8}{1e3 * min(found):>10.1f}{1e3 * np.median(found):>11.1f}"
            f"{share:>16.2f}{memory:>16,.0f}"
        )
    say(f"{processor()}; product {rate:.0f} GFLOP/s; {versions()}")


if __name__ == "__main__":
    before_jax()
    main()
