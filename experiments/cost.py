"""python -m experiments.cost: what the cells' products and convolutions cost, against PPO's.

Counted from the program of a whole update and of acting at the thesis configuration, with
nothing computed: a figure of the equations and the networks, the same on every machine.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

import sndjax
from experiments.estimate import operations
from sndjax.algorithms import NAMED
from sndjax.grid import OBJECTIVES, SIGNALS

STEPS, ENVS = 128, 128
INPUTS = {  # network sizes, a frame, frames in a stack, actions
    "Atari": (sndjax.ATARI, (96, 96, 1), 4, 18),
    "Procgen": (sndjax.PROCGEN, (64, 64, 3), 2, 15),
}


def thesis(
    module: sndjax.IntrinsicModule | None, kind: str
) -> tuple[sndjax.Agent, sndjax.TrainState, sndjax.Experience]:
    """An agent at the thesis configuration, and the shapes of its state and its batch."""
    size, shape, stack, actions = INPUTS[kind]
    motivation = sndjax.Motivation(module) if module else None
    agent = sndjax.Agent(
        sndjax.ActorCritic(size, actions, 2 if module else 1),
        sndjax.Hyperparameters(),
        motivation,
        sndjax.Stack(stack),
    )
    of: Any = jax.ShapeDtypeStruct  # stands for an array
    frame = lambda *rows: of((*rows, *shape), jnp.uint8)
    key: Any = jax.eval_shape(lambda: jax.random.key(0))
    state = jax.eval_shape(partial(sndjax.init, agent), key, frame(ENVS))
    rows = (STEPS, ENVS)
    flag, number = of(rows, bool), of(rows, jnp.float32)
    rollout = sndjax.Rollout(frame(STEPS + 1, ENVS), of(rows, jnp.int32), flag, flag, flag)
    value = of((STEPS + 1, ENVS, agent.network.value_heads), jnp.float32)
    batch = sndjax.Experience(rollout, frame(stack - 1, ENVS), number, flag, number, value)
    return agent, state, batch


def giga_per_step(module: sndjax.IntrinsicModule | None, kind: str) -> float:
    """10^9 floating-point operations per environment step, acting and learning."""
    agent, state, batch = thesis(module, kind)
    update = jax.make_jaxpr(sndjax.make_train_step(agent))(state, batch)
    of: Any = jax.ShapeDtypeStruct
    actor = sndjax.Actor(state.policy, state.observations, state.key)
    newest = batch.rollout.frames.shape[1:]
    window = of((agent.stack.size, *newest), jnp.uint8)
    first, step = of((ENVS,), bool), of((), jnp.int32)
    acting = jax.make_jaxpr(partial(sndjax.act, agent))(
        actor, window, of(newest, jnp.uint8), first, step
    )
    count = operations(update.jaxpr) / (STEPS * ENVS) + operations(acting.jaxpr) / ENVS
    return count / 1e9


def table() -> list[tuple[str, list[float]]]:
    """Every named algorithm, every objective with distillation, every signal on VICReg."""
    lines = []
    makers: dict[str, Any] = dict(NAMED)
    makers |= {f"{o} x distillation": partial(sndjax.grid, o, "distillation") for o in OBJECTIVES}
    makers |= {f"vicreg x {s}": partial(sndjax.grid, "vicreg", s) for s in SIGNALS}
    for name, make in makers.items():
        costs = []
        for kind, (size, _, _, actions) in INPUTS.items():
            costs.append(giga_per_step(make(actions, size) if make else None, kind))
        lines.append((name, costs))
    return lines


def main() -> None:
    """Print the table."""
    print(f"{'':<32}{'Atari':>18}{'Procgen':>20}")
    print(f"{'':<32}" + f"{'GFLOP/step':>12}{'x PPO':>8}" * 2)
    base: list[float] = []
    for name, costs in table():
        base = base or costs
        cells = zip(costs, base, strict=True)
        print(f"{name:<32}" + "".join(f"{c:>12.3f}{c / b:>8.2f}" for c, b in cells), flush=True)


if __name__ == "__main__":
    main()
