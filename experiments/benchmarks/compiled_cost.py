"""The operations, bytes and memory of every algorithm's compiled update.

`tests/experiments/benchmarks/test_compiled_cost.py` compares the programs with committed figures,
so that an increase of the work is noticed.
"""

import json
from importlib.metadata import version
from typing import Any

import jax

import sndjax
from sndjax.algorithms import NAMED

from ..config.validation import unknown_name_error
from ..training.flops import count_flops
from .counted_flops import INPUTS, thesis_experiment

ALGORITHMS = ("ppo", "rnd", "icm", "sp", "snd_vic", "snd_std")


def compiled_figures(name: str) -> dict[str, float]:
    """Compile the update of one algorithm, and return its figures."""
    size, _, _, actions = INPUTS["Atari"]
    make = NAMED[name]
    agent, state, batch = thesis_experiment(make(actions, size) if make else None, "Atari")
    step = jax.jit(sndjax.make_train_step(agent), donate_argnums=0)
    traced = step.trace(state, batch)
    compiled = traced.lower().compile()
    found: Any = compiled.cost_analysis()
    memory: Any = compiled.memory_analysis()
    return {
        "gflop_of_products": count_flops(traced.jaxpr.jaxpr) / 1e9,
        "gflop_loops_once": found["flops"] / 1e9,
        "gigabytes_loops_once": found["bytes accessed"] / 1e9,
        "temporary_mb": memory.temp_size_in_bytes / 1e6,
    }


def check_names(names: list[str]) -> None:
    """Check that every name is an algorithm.

    Raises:
      ConfigError: a name is not an algorithm.
    """
    for name in names:
        if name not in NAMED:
            raise unknown_name_error("algorithm", name, NAMED)


def print_compiled_cost(names: list[str]) -> None:
    """Print one JSON object with the figures of these algorithms.

    Raises:
      ConfigError: a name is not an algorithm.
    """
    check_names(names)
    found = {name: compiled_figures(name) for name in names}
    print(json.dumps({"jaxlib": version("jaxlib"), "algorithms": found}, indent=2))
