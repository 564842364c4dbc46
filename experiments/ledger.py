"""python -m experiments.ledger [NAME ...]: what the compiled updates compute.

Prints one JSON object: of each algorithm's `train_step` at the thesis configuration on Atari the
operations of its products, every turn of a loop counted; XLA's own count of operations and of
bytes read and written, to which the body of a loop counts once; and the megabytes of temporaries.
`tests/experiments/test_ledger.py` holds the programs to the
figures in `tests/experiments/ledger.json`, so that work that comes back unseen is seen.
"""

import json
import sys
from importlib.metadata import version
from typing import Any

import jax

import sndjax
from experiments.cost import INPUTS, thesis
from experiments.estimate import operations
from experiments.process import before_jax
from sndjax.algorithms import NAMED

ALGORITHMS = ("ppo", "rnd", "icm", "sp", "snd_vic", "snd_std")


def entry(name: str) -> dict[str, float]:
    """The figures of one algorithm."""
    size, _, _, actions = INPUTS["Atari"]
    make = NAMED[name]
    agent, state, batch = thesis(make(actions, size) if make else None, "Atari")
    step = jax.jit(sndjax.make_train_step(agent), donate_argnums=0)
    traced = step.trace(state, batch)
    compiled = traced.lower().compile()
    found: Any = compiled.cost_analysis()
    memory: Any = compiled.memory_analysis()
    return {
        "gflop_of_products": operations(traced.jaxpr.jaxpr) / 1e9,
        "gflop_loops_once": found["flops"] / 1e9,
        "gigabytes_loops_once": found["bytes accessed"] / 1e9,
        "temporary_mb": memory.temp_size_in_bytes / 1e6,
    }


def main(names: list[str]) -> None:
    """Print the figures."""
    found = {name: entry(name) for name in names or ALGORITHMS}
    print(json.dumps({"jaxlib": version("jaxlib"), "algorithms": found}, indent=2))


if __name__ == "__main__":
    before_jax()
    main(sys.argv[1:])
