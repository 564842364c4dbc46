"""One iteration after another: rollouts collected on the host, learned from on the device."""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

import sndjax

from ..system.display import Progress, format_duration
from ..system.errors import TaskError
from ..system.interrupts import Interrupted, Interrupts
from ..system.jax_settings import jit_is_disabled
from ..system.process import return_freed_memory
from .background_learner import BackgroundLearner
from .experiment import Experiment, RunState
from .flops import estimate_seconds
from .learners import Learner, SlicedLearner, make_learner
from .policy_lag import actor_of, lagging_actor, policy_lag
from .rollouts import Collector, RolloutInfo
from .scan_collector import ScanCollector
from .seeds import map_over_seeds

Collected = tuple[sndjax.Experience, RolloutInfo]
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

    def breakable(self, grace: float = 0.0, started: bool = False) -> AbstractContextManager[None]:
        """Return a context in which a signal interrupts waiting, if this is the only host.

        Args:
          grace: see `Interrupts.waiting`.
          started: see there.
        """
        return self.interrupts.waiting(grace, started) if self.hosts == 1 else nullcontext()

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
    """Iterations whose environments step outside jax.

    Where it can, an iteration collects the next rollout while it learns from its own: with
    overlap=1 with the policy before it, else with the policy after it, while the module learns.
    """

    def __init__(
        self,
        experiment: Experiment,
        collector: Collector | ScanCollector,
        watch: Watch,
        done: int,
        learner: Learner | None = None,
    ):
        """Take the parts; nothing is compiled yet.

        Args:
          experiment: of the run.
          collector: of its rollouts.
          watch: its display and its signals.
          done: the number of iterations that were run before.
          learner: how it learns; None: as `make_learner` chooses.
        """
        self.experiment, self.watch, self.done = experiment, watch, done
        self.placement, self.collector = experiment.placement, collector
        config = experiment.config
        chosen = make_learner(experiment) if learner is None else learner
        self.ahead = bool(config.overlap) or isinstance(chosen, SlicedLearner)
        self.learner: Learner = BackgroundLearner(chosen) if self.ahead else chosen
        self.lagging = jax.jit(map_over_seeds(lagging_actor, config.num_seeds))
        self.lag = jax.jit(policy_lag)
        self.collected: Collected | None = None  # the rollout of the next iteration
        self.failed: Interrupted | TaskError | None = None  # while it was collected
        self.update_seconds: float | None = None  # the expected time of an update
        watch.progress.phase("compiling the policy")

    def run(
        self, state: RunState, most: int
    ) -> tuple[RunState, list[IterationResult], sndjax.Experience]:
        if self.failed is not None:
            raise self.failed
        begun = time.monotonic()
        batch, info = self.collected or self.collect(self.current_actor(state))
        parts: dict[str, float | None] = {"collect_seconds": time.monotonic() - begun}
        self.collected = None
        if self.update_seconds is None:
            compiler = self.watch.compile
            self.update_seconds = self.learner.compile(compiler, state.train, batch)
        lag: dict[str, Any] = {}
        next_actor: Any = ()
        if self.experiment.config.overlap:
            lag = {"policy_lag": self.lag(state.train, state.next_actor)}
            next_actor = self.lagging(state.train)  # before its memory is reused
        learning = time.monotonic()
        self.learner.begin(state.train, batch)
        self.done += 1
        if self.ahead and self.done < self.experiment.config.iterations:
            parts["collect_seconds"] = self.collect_ahead(next_actor)
        waiting = time.monotonic()
        self.watch.progress.phase("learning", None if self.ahead else self.update_seconds)
        with self.watch.breakable(GRACE_SECONDS, started=self.ahead):
            train, found, reward = jax.block_until_ready(self.learner.finish())
        now = time.monotonic()
        if self.ahead:
            parts["wait_seconds"] = now - waiting
        else:
            parts["update_seconds"] = self.update_seconds = now - learning
        result = IterationResult(
            info=info,
            metrics={name: np.asarray(value).tolist() for name, value in (found | lag).items()},
            int_reward=np.asarray(reward),
            seconds=now - begun,
            parts=parts,
        )
        return RunState(train, state.environments, next_actor), [result], batch

    def current_actor(self, state: RunState) -> sndjax.Actor:
        """Return the policy that collects the rollout of this iteration."""
        return state.next_actor.actor if self.experiment.config.overlap else actor_of(state.train)

    def collect_ahead(self, next_actor: Any) -> float:
        """Collect the rollout of the next iteration, and return the seconds that it took.

        What fails here is raised in the next iteration: this one is not lost.

        Args:
          next_actor: with overlap=1, the policy that collects it.
        """
        actor = next_actor.actor if next_actor else self.learner.learn_policy()
        begun = time.monotonic()
        try:
            self.collected = self.collect(actor, self.learner.advance)
        except (Interrupted, TaskError) as error:
            self.failed = error
        return time.monotonic() - begun

    def collect(
        self, actor: sndjax.Actor, beside: Callable[[float], None] | None = None
    ) -> Collected:
        """Collect the next rollout.

        Args:
          actor: the policy of every seed.
          beside: see `Collector.collect`; None: nothing runs while it is collected.

        Returns:
          The batch for `train_step`, and the data for the log, of all hosts.

        Raises:
          Interrupted: a signal was received.
          TaskError: the environment failed.
        """
        progress, interrupts, hosts = self.watch
        progress.phase("collecting" if beside is None else "collecting and learning")
        steps = self.experiment.config.rollout_length

        def stepped(step: int) -> None:
            interrupts.begin()  # the policy is compiled: from here on `check` is called often
            if hosts == 1:  # several hosts stop together, after an iteration
                interrupts.check()
            progress.within(step / steps)

        batch, info = self.collector.collect(
            self.placement.put_actor(actor), stepped, beside or (lambda share: None)
        )
        return self.placement.put_batch(batch), self.placement.gather_hosts(info)

    def repeat(
        self, state: RunState, count: int, batch: sndjax.Experience
    ) -> tuple[RunState, sndjax.Experience]:
        assert count == 0
        return state, batch
