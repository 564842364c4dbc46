"""How often random actions solve a task of the trial."""

import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import sndjax
from sndjax.collecting import step_environments

from ..config.compose import load_config
from ..environments.jax_environments import make_environment
from .protocol import Protocol, Task
from .rows import write_json

FILE = "chance.json"
STEPS, ENVS, SEED = 10_000_000, 1000, 0


def play_at_random(env: sndjax.JaxEnvironment, steps: int, envs: int) -> tuple[int, int]:
    """Play random actions, and return how many episodes ended and how many were solved.

    Args:
      env: the environment.
      steps: of all environments together.
      envs: how many are played side by side.
    """

    def step(carry: Any, t: Any) -> Any:
        live, total, ended, solved = carry
        key = jax.random.fold_in(jax.random.key(SEED), t)
        key_action, key_env = jax.random.split(key)
        action = jax.random.randint(key_action, (envs,), 0, env.num_actions)
        row, live = step_environments(env, live, action, key_env)
        total = total + row.reward
        solved += ((total > 0) & row.done).sum()
        return (live, jnp.where(row.done, 0, total), ended + row.done.sum(), solved), None

    live = sndjax.init_environments(env, jax.random.key(SEED), envs)
    start = (live, jnp.zeros(envs), jnp.int32(0), jnp.int32(0))
    play = jax.jit(lambda: jax.lax.scan(step, start, jnp.arange(steps // envs))[0])
    _, _, ended, solved = play()
    return int(ended), int(solved)


def measure_chance(protocol: Protocol, out: Path) -> dict[str, list[int]]:
    """Return the ended and the solved episodes of random actions for every task, and store them.

    Args:
      protocol: of the trial.
      out: the directory of its results; what its file holds is not measured again.
    """
    path = out / FILE
    found: dict[str, list[int]] = json.loads(path.read_text()) if path.exists() else {}
    for task in protocol.tasks.values():
        if task.name not in found:
            found[task.name] = list(chance_of(task))
            write_json(path, found)
    return found


def chance_of(task: Task) -> tuple[int, int]:
    """Return the ended and the solved episodes of random actions.

    Args:
      task: of the trial.
    """
    agent = [given for given in task.arguments if not given.startswith("network")]
    env = make_environment(load_config([*agent, "algo=ppo"]).env)
    return play_at_random(env, STEPS, ENVS)


def format_chance(ended: int, solved: int) -> str:
    """Return the share of solved episodes, or its upper bound where there were none.

    With no success in n episodes the 95% upper bound is 1 - 0.05 ** (1 / n).

    >>> format_chance(1000, 20), format_chance(1000, 0)
    ('2.0e-02', '< 3.0e-03')
    """
    if solved:
        return f"{solved / ended:.1e}"
    return f"< {-math.expm1(math.log(0.05) / max(ended, 1)):.1e}"
