"""The measurements of `gpu_suite`, each in the process that calls it."""

import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from ..config.compose import load_config
from ..training.cpu_cores import use_cores
from ..training.device_mesh import choose_placement
from ..training.experiment import build_experiment
from ..training.learners import SlicedLearner, WholeLearner
from .gpu_numbers import compare_numbers
from .gpu_steps import GAME, THREADS, Step
from .whole_iterations import time_iterations

# In place of the game, and of its sizes, on a CPU.
TOY = ["env=gymnasium", "env.id=CartPole-v1", "algo=snd_vic", "num_envs=8", "rollout_length=16"]
TOY += ["ppo.minibatch_size=64", "algo.minibatch_size=64"]
TOY_SIZES = {"num_envs": "num_envs=16", "num_seeds": "num_seeds=2"}
LEARNERS: dict[str | None, Any] = {None: None, "whole": WholeLearner, "sliced": SlicedLearner}
TIMED = 3  # iterations
STEPPED = 20  # steps of all environments with random actions, three times


def measure(step: Step, toy: bool) -> Iterator[dict[str, Any]]:
    """Yield the rows of a step.

    Args:
      step: what to measure.
      toy: of a small task.
    """
    if step.kind == "numbers":
        yield from compare_numbers(toy)
    elif step.kind == "pool":
        yield random_actions(step_options(step, toy))
    else:
        yield whole_rate(step, step_options(step, toy))


def step_options(step: Step, toy: bool) -> list[str]:
    """Return the options of a step's run.

    Args:
      step: the step.
      toy: of a small task.
    """
    if not toy:
        return list(step.options)
    given = [*TOY, *step.options[len(GAME) :]] if step.of_game else list(step.options)
    given = [one for one in given if one != THREADS]  # of envpool alone
    own = {one.partition("=")[0]: one for one in given}  # of two with one name the last
    return [TOY_SIZES.get(name, one) if one not in TOY else one for name, one in own.items()]


def whole_rate(step: Step, options: list[str]) -> dict[str, Any]:
    """Return the rate of whole iterations.

    Args:
      step: says how it learns, and in how many pools.
      options: of the run.
    """
    config = load_config(options)
    if step.learner != "sliced":  # pieces are for one device
        use_cores(config)
    experiment = build_experiment(config, choose_placement(config), groups=step.groups)
    collector = experiment.make_collector()
    times = time_iterations(experiment, collector, TIMED, LEARNERS[step.learner])
    collector.close()
    steps = config.rows * config.num_seeds
    found: dict[str, Any] = {"steps_per_second": steps / times.whole, "options": " ".join(options)}
    if times.collecting is not None:
        found["collecting_share"] = times.collecting / times.whole
    return found


def random_actions(options: list[str]) -> dict[str, Any]:
    """Return the rate at which the pools of a run step with random actions.

    Args:
      options: of the run.
    """
    config = load_config(options)
    pools, draw = build_experiment(config).pools, np.random.default_rng(0)
    shape = (config.num_seeds, config.num_envs // len(pools))
    rates = []
    for pool in pools:
        pool.reset()
    for _ in range(4):
        begun = time.perf_counter()
        for _ in range(STEPPED):
            for pool in pools:
                pool.send(draw.integers(0, pool.num_actions, shape, np.int32))
            for pool in pools:
                pool.receive()
        rates.append(STEPPED * config.num_envs / (time.perf_counter() - begun))
    for pool in pools:
        pool.close()
    return {"steps_per_second": float(np.median(rates[1:])), "pools": len(pools)}
