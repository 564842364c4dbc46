"""The operations of the algorithms and cells relative to PPO, counted and not timed.

The matrix products and convolutions are counted in the program of a whole update and of acting, at
the thesis configuration.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

import sndjax
from sndjax.algorithms import NAMED
from sndjax.grid import OBJECTIVES, SIGNALS

from ..training.flops import count_flops

STEPS, ENVS = 128, 128
INPUTS = {  # network sizes, a frame, frames in a stack, actions
    "Atari": (sndjax.ATARI, (96, 96, 1), 4, 18),
    "Procgen": (sndjax.PROCGEN, (64, 64, 3), 2, 15),
}


def thesis_experiment(
    module: sndjax.IntrinsicModule | None, kind: str
) -> tuple[sndjax.AgentSpec, sndjax.TrainState, sndjax.Experience]:
    """Return an agent at the thesis configuration, and the shapes of its state and batch."""
    size, shape, stack, actions = INPUTS[kind]
    agent = sndjax.AgentSpec(
        network=sndjax.ActorCritic(size, actions, 2 if module else 1),
        ppo=sndjax.Hyperparameters(),
        intrinsic=sndjax.IntrinsicConfig(module) if module else None,
        stack=sndjax.FrameStack(stack),
    )
    of: Any = jax.ShapeDtypeStruct  # the shape and dtype of an array
    frame = lambda *rows: of((*rows, *shape), jnp.uint8)
    key: Any = jax.eval_shape(lambda: jax.random.key(0))
    state = jax.eval_shape(partial(sndjax.init_train_state, agent), key, frame(ENVS))
    rows = (STEPS, ENVS)
    flag, number = of(rows, bool), of(rows, jnp.float32)
    rollout = sndjax.Rollout(frame(STEPS + 1, ENVS), of(rows, jnp.int32), flag, flag, flag)
    value = of((STEPS + 1, ENVS, agent.network.value_heads), jnp.float32)
    batch = sndjax.Experience(rollout, frame(stack - 1, ENVS), number, flag, number, value)
    return agent, state, batch


def gflop_per_step(module: sndjax.IntrinsicModule | None, kind: str) -> float:
    """Count 10^9 floating-point operations per environment step, acting and learning."""
    agent, state, batch = thesis_experiment(module, kind)
    update = jax.make_jaxpr(sndjax.make_train_step(agent))(state, batch)
    of: Any = jax.ShapeDtypeStruct
    actor = sndjax.Actor(state.policy, state.observations, state.key)
    newest = batch.rollout.frames.shape[1:]
    window = of((agent.stack.size, *newest), jnp.uint8)
    first, step = of((ENVS,), bool), of((), jnp.int32)
    acting = jax.make_jaxpr(partial(sndjax.act, agent))(
        actor, sndjax.ActorMemory(window), of(newest, jnp.uint8), first, step
    )
    count = count_flops(update.jaxpr) / (STEPS * ENVS) + count_flops(acting.jaxpr) / ENVS
    return count / 1e9


def cost_rows() -> Iterator[tuple[str, list[float]]]:
    """Yield every named algorithm and many cells, each with its costs on both inputs.

    The cells are every objective with distillation, and every signal on VICReg.
    """
    makers: dict[str, Any] = dict(NAMED)
    makers |= {
        f"{o} x distillation": partial(sndjax.make_module, o, "distillation") for o in OBJECTIVES
    }
    makers |= {f"vicreg x {s}": partial(sndjax.make_module, "vicreg", s) for s in SIGNALS}
    for name, make in makers.items():
        costs = []
        for kind, (size, _, _, actions) in INPUTS.items():
            costs.append(gflop_per_step(make(actions, size) if make else None, kind))
        yield name, costs


def print_costs() -> None:
    """Print the table, each line as soon as it is counted."""
    print(f"{'':<32}{'Atari':>18}{'Procgen':>20}")
    print(f"{'':<32}" + f"{'GFLOP/step':>12}{'x PPO':>8}" * 2)
    base: list[float] = []
    for name, costs in cost_rows():
        base = base or costs
        pairs = zip(costs, base, strict=True)
        print(f"{name:<32}" + "".join(f"{c:>12.3f}{c / b:>8.2f}" for c, b in pairs), flush=True)
