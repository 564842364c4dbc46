"""Iterations of environments in JAX: collection and learning in one program, several in a call."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import sndjax

from .agents import make_seed_train_step
from .experiment import Experiment, RunState
from .iterations import GRACE_SECONDS, IterationResult, Watch
from .policy_lag import actor_of, lagging_actor, policy_lag
from .rollouts import RolloutInfo
from .scan_collector import make_jax_collect
from .seeds import map_over_seeds

CALL_SECONDS = 1.0  # about as long as a call lasts: signals and checkpoints wait for its end
MOST_BYTES = 64 << 20  # of the results of a call
MOST_ITERATIONS = 256


class Row(NamedTuple):
    """The results of an iteration that leave the device, a leaf for every seed."""

    metrics: dict[str, Any]
    valid: Any
    done: Any
    reward: Any
    score: Any
    int_reward: Any


def visit_metrics(visits: sndjax.Visits | None) -> dict[str, Any]:
    """Return the metrics of what environments have seen so far; none without places.

    `coverage` is the number of distinct places, `progress` the mean over all episodes that ended, 0
    before the first one.

    Args:
      visits: see `sndjax.JaxEnvironment.place`.
    """
    if visits is None:
        return {}
    return {
        "coverage": visits.visited.sum(),
        "progress": visits.progress / jnp.maximum(visits.episodes, 1),
    }


def make_iteration(experiment: Experiment) -> Callable[..., Any]:
    """Return an iteration of one seed, not jitted.

    Returns:
      (train, environments, next actor) -> (train, environments, next actor, row, batch).
    """
    config, agent, env = experiment.config, experiment.agent, experiment.pool.environment
    assert env is not None
    collect = make_jax_collect(env, agent, config)
    train_step = make_seed_train_step(agent, config, experiment.placement)

    def iterate(train: sndjax.TrainState, live: sndjax.LiveEnvironments, acting: Any) -> Any:
        batch, live, score = collect(acting.actor if config.overlap else actor_of(train), live)
        rollout = batch.rollout
        lag = {"policy_lag": policy_lag(train, acting)} if config.overlap else {}
        after = lagging_actor(train) if config.overlap else ()
        train, metrics, int_reward = train_step(train, batch)
        row = Row(
            metrics=metrics | lag | visit_metrics(live.visits),
            valid=rollout.valid,
            done=rollout.done,
            reward=batch.reward,
            score=score,
            int_reward=int_reward,
        )
        return train, live, after, row, batch

    return iterate


def make_iterations(experiment: Experiment, most: int) -> Callable[..., Any]:
    """Return a function that runs iterations of all seeds, not jitted.

    Their number is an argument, so that a run does not depend on how it is divided into calls.

    Args:
      experiment: of the run.
      most: the largest number of iterations of a call.

    Returns:
      (state, count) -> (state, rows with leaves [most, S, ...], the last batch).
    """
    seeds = experiment.placement.seeds_here(experiment.config.num_seeds)
    iterate = map_over_seeds(make_iteration(experiment), seeds, axis=experiment.placement.axis)

    def run(state: RunState, count: jax.Array) -> tuple[RunState, Row, sndjax.Experience]:
        shapes = jax.eval_shape(iterate, *state)[3:]
        row, batch = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        rows = jax.tree.map(lambda x: jnp.zeros((most, *x.shape), x.dtype), row)

        def body(i: Any, carry: Any) -> Any:
            state, rows, _ = carry
            *after, row, batch = iterate(*state)
            rows = jax.tree.map(lambda kept, new: kept.at[i].set(new), rows, row)
            return RunState(*after), rows, batch

        return lax.fori_loop(0, count, body, (state, rows, batch))

    return run


class FusedIterations:
    """Iterations in which environments, policy and learning are one compiled program."""

    def __init__(self, experiment: Experiment, watch: Watch):
        """Set the largest number of iterations of a call; nothing is compiled yet.

        Args:
          experiment: of the run.
          watch: its display and its signals.
        """
        config = experiment.config
        self.experiment, self.watch = experiment, watch
        each = config.num_seeds * config.rows * 16  # bytes of a `Row`
        self.most = config.iterations_per_call or min(
            MOST_ITERATIONS, max(1, MOST_BYTES // each), config.iterations
        )
        self.program = experiment.placement.compile_iterations(
            make_iterations(experiment, self.most)
        )
        self.compiled: Any = None
        self.seconds: float | None = None  # of an iteration, once it was measured
        self.estimate: float | None = None

    def count(self, most: int) -> int:
        """Return the number of iterations of the next call, at most `most`."""
        wanted = self.experiment.config.iterations_per_call
        if wanted is None:
            # Several hosts must agree, and their clocks do not.
            unknown = self.seconds is None or self.watch.hosts > 1
            wanted = 1 if unknown else round(CALL_SECONDS / cast(float, self.seconds))
        return max(1, min(wanted, most, self.most))

    def run(
        self, state: RunState, most: int
    ) -> tuple[RunState, list[IterationResult], sndjax.Experience]:
        count = self.count(most)
        if self.compiled is None:
            self.compiled, self.estimate = self.watch.compile(
                "iteration", self.program, state, jnp.int32(count)
            )
        self.watch.interrupts.begin()
        each = self.estimate if self.seconds is None else self.seconds
        self.watch.progress.phase("collecting and learning", each and each * count)
        begun = time.monotonic()
        with self.watch.breakable(GRACE_SECONDS):
            state, rows, batch = jax.block_until_ready(self.compiled(state, jnp.int32(count)))
        self.seconds = (time.monotonic() - begun) / count
        rows = jax.tree.map(np.asarray, rows)
        own = [jax.tree.map(lambda x, j=j: x[j], rows) for j in range(count)]
        return state, [self.result(row) for row in own], batch

    def result(self, row: Row) -> IterationResult:
        """Return the result of an iteration."""
        assert self.seconds is not None
        info = RolloutInfo(
            valid=row.valid, game_over=row.done, reward=row.reward, score=row.score, room=None
        )
        metrics = {name: value.tolist() for name, value in row.metrics.items()}
        return IterationResult(info, metrics, row.int_reward, self.seconds, {})

    def repeat(
        self, state: RunState, count: int, batch: sndjax.Experience
    ) -> tuple[RunState, sndjax.Experience]:
        copy = jax.jit(lambda tree: jax.tree.map(jnp.copy, tree))
        before, _, _ = self.compiled(copy(state), jnp.int32(count))
        _, _, batch = self.compiled(copy(before), jnp.int32(1))
        return before, batch
