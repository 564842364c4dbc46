"""Time measurement relative to a matrix product, for machines of changing speed."""

import os
import platform
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

REPEATS = 3
MATMUL_SIZE = 4096  # rows and columns of the matrices in the product


def print_line(text: str) -> None:
    """Print a line, and flush the output."""
    print(text, flush=True)


class BenchmarkTimer:
    """A timer of work and of a matrix product, because a shared machine changes its speed."""

    def __init__(self) -> None:
        """Start without a measurement."""
        self.product = jax.jit(partial(jnp.matmul, precision="highest"))
        self.products: list[float] = []  # seconds

    def time_product(self) -> None:
        """Time a float32 matrix product of 4096 x 4096 x 4096."""
        a = jnp.ones((MATMUL_SIZE, MATMUL_SIZE), jnp.float32)
        begun = time.perf_counter()
        self.product(a, a).block_until_ready()
        self.products.append(time.perf_counter() - begun)

    def gflops(self) -> float:
        """Return the median rate of the product, in 10^9 operations per second."""
        return 2 * MATMUL_SIZE**3 / float(np.median(self.products)) / 1e9

    def seconds(self, work: Callable[[], Any]) -> float:
        """Return the median seconds of the work.

        The work first runs once untimed; a matrix product is timed before each timed run.
        """
        jax.block_until_ready(work())
        times = []
        for _ in range(REPEATS):
            self.time_product()
            begun = time.perf_counter()
            jax.block_until_ready(work())
            times.append(time.perf_counter() - begun)
        return float(np.median(times))


def device_name() -> str:
    """Return the name of the device: jax's name, or the CPU's model and number of cores."""
    if jax.default_backend() != "cpu":
        return jax.devices()[0].device_kind
    try:
        with open("/proc/cpuinfo") as file:
            lines = [line for line in file if line.startswith("model name")]
        model = lines[0].split(":")[1].strip()
    except (OSError, IndexError):
        model = platform.processor() or platform.machine()
    return f"{model}, {os.cpu_count()} cores"
