"""The time of whole iterations, as a run takes them: collecting and learning in its own way."""

from collections.abc import Callable
from statistics import median
from time import perf_counter
from typing import Any, NamedTuple

import jax

from ..config.schema import Config
from ..system.display import Progress
from ..system.interrupts import Interrupts
from ..training.device_mesh import choose_placement
from ..training.experiment import Experiment, build_experiment
from ..training.fused_iterations import FusedIterations
from ..training.iterations import HostIterations, IterationResult, Iterations, Watch
from ..training.learners import Learner
from ..training.placement import SINGLE_DEVICE
from ..training.policy_lag import actor_of
from ..training.rollouts import Collector
from ..training.scan_collector import ScanCollector


class IterationTimes(NamedTuple):
    """Seconds of an iteration, medians over some.

    Attributes:
      whole: of an iteration.
      collecting: of collecting a rollout; None where it is part of one program.
    """

    whole: float
    collecting: float | None


def time_iterations(
    experiment: Experiment,
    collector: Collector | ScanCollector,
    count: int,
    make_learner: Callable[[Experiment], Learner] | None = None,
) -> IterationTimes:
    """Run iterations of an experiment from its start, and return their times.

    The first two are not timed: they compile, and the first one collects two rollouts where the
    next one is collected while it learns.

    Args:
      experiment: what runs; it must have more than `count` + 2 iterations.
      collector: of its rollouts; not used where environments live in JAX.
      count: the number of iterations that are timed.
      make_learner: makes how it learns; None: as a run does.
    """
    progress = Progress("", 1, 0)
    watch = Watch(progress, Interrupts(), 1)
    learner = make_learner and make_learner(experiment)
    iterations: Iterations = (
        FusedIterations(experiment, watch)
        if experiment.pool.environment is not None
        else HostIterations(experiment, collector, watch, 0, learner)
    )
    state, results = experiment.init_run(), list[IterationResult]()
    while len(results) < count + 2:
        state, found, _ = iterations.run(state, 1)
        results += found
    progress.close()
    timed = results[2:]
    parts: list[Any] = [result.parts.get("collect_seconds") for result in timed]
    collecting = None if None in parts else median(parts)
    return IterationTimes(median(result.seconds for result in timed), collecting)


def time_alone(
    experiment: Experiment, collector: Collector | ScanCollector, count: int
) -> tuple[float, float]:
    """Return the seconds of collecting and of learning, each while nothing else runs: medians.

    Args:
      experiment: whose environments step outside jax.
      collector: of its rollouts.
      count: how often each is timed, after one time that is not.
    """
    placement, state = experiment.placement, experiment.init_run()
    actor = placement.put_actor(jax.tree.map(jax.numpy.copy, actor_of(state.train)))
    step, train = placement.compile_train_step(experiment.make_train_step()), state.train
    collecting, learning = [], []
    for _ in range(count + 1):
        begun = perf_counter()
        batch = placement.put_batch(collector.collect(actor)[0])
        collected = perf_counter()
        train, _, _ = jax.block_until_ready(step(train, batch))
        collecting.append(collected - begun)
        learning.append(perf_counter() - collected)
    return median(collecting[1:]), median(learning[1:])


def measure_whole(config: Config, phases: float, count: int) -> dict[str, Any]:
    """Return the figures of whole iterations, on the devices that a run would use.

    With overlap=1 also the times of collecting and of learning alone, and the share of the slower
    one's rate that a whole iteration reaches: 1 where the other is free, about 0.5 where they are
    equal and take turns.

    Args:
      config: of the run; with overlap=1 `use_cores` was called before jax started.
      phases: the seconds of an iteration's phases, one after another.
      count: the number of iterations that are timed.
    """
    placement = choose_placement(config) if config.overlap else SINGLE_DEVICE
    experiment = build_experiment(config, placement)
    collector = experiment.make_collector()
    times = time_iterations(experiment, collector, count)
    found: dict[str, Any] = {
        "whole_steps_per_second": config.rows * config.num_seeds / times.whole,
        "phases_over_whole": phases / times.whole,
    }
    if times.collecting is not None:
        found["whole_collecting_share"] = times.collecting / times.whole
    if config.overlap and experiment.pool.environment is None:
        collecting, learning = time_alone(experiment, collector, count)
        found |= {
            "whole_seconds": times.whole,
            "collecting_alone_seconds": collecting,
            "learning_alone_seconds": learning,
            "of_the_slower": max(collecting, learning) / times.whole,
        }
    collector.close()
    return found
