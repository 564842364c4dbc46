"""One iteration after another: rollouts collected on the host, learned from on the device."""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

import sndjax

from ..system.display import Progress, format_duration
from ..system.interrupts import Interrupts
from ..system.jax_settings import jit_is_disabled
from ..system.process import return_freed_memory
from .experiment import Experiment, RunState
from .flops import estimate_seconds
from .rollouts import Collector, RolloutInfo
from .scan_collector import ScanCollector

GRACE_SECONDS = 4  # for an update to end after SIGTERM; short, to leave time for a checkpoint


class IterationResult(NamedTuple):
    """What the log needs of an iteration.

    Attributes:
      info: the data of its rollout.
      metrics: of its update by name, a value for every seed.
      int_reward: its intrinsic rewards, [S, T, N].
      seconds: how long it took.
      parts: the seconds of its parts by name; {} if they are not known.
    """

    info: RolloutInfo
    metrics: dict[str, list[float]]
    int_reward: np.ndarray
    seconds: float
    parts: dict[str, float | None]


class Iterations(Protocol):
    """How a run takes its iterations."""

    def run(
        self, state: RunState, most: int
    ) -> tuple[RunState, list[IterationResult], sndjax.Experience]:
        """Run one iteration or more; the state is donated.

        Args:
          state: of all seeds.
          most: the number of iterations that may be run.

        Returns:
          The state after them, their results, and the last rollout.

        Raises:
          Interrupted: a signal was received.
          TaskError: the environment failed.
        """

    def repeat(
        self, state: RunState, count: int, batch: sndjax.Experience
    ) -> tuple[RunState, sndjax.Experience]:
        """Return the state after some iterations that were run before, and the next rollout.

        Args:
          state: before the iterations of the last call of `run`.
          count: how many of them.
          batch: the last rollout of that call.
        """


class Watch(NamedTuple):
    """What the user sees and what stops a run, while iterations run.

    Attributes:
      progress: the display.
      interrupts: the signals that this process receives.
      hosts: the number of processes of the run.
    """

    progress: Progress
    interrupts: Interrupts
    hosts: int

    def breakable(self, grace: float = 0.0) -> AbstractContextManager[None]:
        """Return a context in which a signal interrupts waiting, if this is the only host."""
        return self.interrupts.waiting(grace) if self.hosts == 1 else nullcontext()

    def compile(self, what: str, function: Any, *args: Any) -> tuple[Callable[..., Any], float]:
        """Compile a jitted function, and return it with an estimate of its seconds.

        Args:
          what: its name, for the user.
          function: the function.
          *args: its arguments.
        """
        if jit_is_disabled():
            return function, 0.0
        self.progress.phase(f"compiling the {what}")
        begun = time.monotonic()
        with self.breakable():
            traced = function.trace(*args)
            compiled = traced.lower().compile()
        seconds = estimate_seconds(traced.jaxpr.jaxpr)
        return_freed_memory()
        each = format_duration(seconds)
        took = time.monotonic() - begun
        self.progress.say(f"{what} compiled in {took:.0f} s; each takes about {each}")
        return compiled, seconds


class HostIterations:
    """Iterations whose environments step outside jax."""

    def __init__(self, experiment: Experiment, collector: Collector | ScanCollector, watch: Watch):
        """Take the parts; nothing is compiled yet.

        Args:
          experiment: of the run.
          collector: of its rollouts.
          watch: its display and its signals.
        """
        self.experiment, self.watch = experiment, watch
        self.placement = experiment.placement
        self.collector = collector
        self.train_step = self.placement.compile_train_step(experiment.make_train_step())
        self.update: Any = None  # the compiled train_step
        self.update_seconds: float | None = None  # the expected time of an update
        watch.progress.phase("compiling the policy")

    def run(
        self, state: RunState, most: int
    ) -> tuple[RunState, list[IterationResult], sndjax.Experience]:
        begun = time.monotonic()
        batch, info = self.collect(state.train)
        collected = time.monotonic()
        if self.update is None:
            self.update, self.update_seconds = self.watch.compile(
                "update", self.train_step, state.train, batch
            )
        self.watch.progress.phase("learning", self.update_seconds)
        learning = time.monotonic()
        with self.watch.breakable(GRACE_SECONDS):
            train, found, reward = jax.block_until_ready(self.update(state.train, batch))
        self.update_seconds = time.monotonic() - learning
        result = IterationResult(
            info=info,
            metrics={name: np.asarray(value).tolist() for name, value in found.items()},
            int_reward=np.asarray(reward),
            seconds=time.monotonic() - begun,
            parts={
                "collect_seconds": collected - begun,
                "update_seconds": self.update_seconds,
            },
        )
        return state._replace(train=train), [result], batch

    def collect(self, train: sndjax.TrainState) -> tuple[sndjax.Experience, RolloutInfo]:
        """Collect the next rollout.

        Args:
          train: the state of every seed.

        Returns:
          The batch for `train_step`, and the data for the log, of all hosts.

        Raises:
          Interrupted: a signal was received.
        """
        progress, interrupts, hosts = self.watch
        progress.phase("collecting")
        steps = self.experiment.config.rollout_length

        def stepped(step: int) -> None:
            interrupts.begin()  # the policy is compiled: from here on `check` is called often
            if hosts == 1:  # several hosts stop together, after an iteration
                interrupts.check()
            progress.within(step / steps)

        actor = sndjax.Actor(train.policy, train.observations, train.key)
        batch, info = self.collector.collect(self.placement.put_actor(actor), stepped)
        return self.placement.put_batch(batch), self.placement.gather_hosts(info)

    def repeat(
        self, state: RunState, count: int, batch: sndjax.Experience
    ) -> tuple[RunState, sndjax.Experience]:
        assert count == 0
        return state, batch
