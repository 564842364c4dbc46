"""The training loop of a run: rollout -> train_step -> log, for every iteration."""

import signal
import time
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import sndjax

from ..config.schema import Config
from ..storage.episodes import EpisodeTracker
from ..storage.run_directory import FollowerDirectory, RunDirectory
from ..storage.run_logs import mean_over_seeds
from ..system.display import Progress, format_duration
from ..system.errors import NonFiniteError, TaskError
from ..system.interrupts import Interrupted, Interrupts
from ..system.jax_settings import apply_debug_settings, jit_is_disabled
from ..system.process import enable_compilation_cache, return_freed_memory
from ..system.versions import versions
from .diagnostics import HealthMonitor, announcements
from .experiment import build_experiment
from .flops import estimate_seconds
from .nonfinite import keep_failed_update, nonfinite_terms
from .placement import choose_placement
from .rollouts import RolloutInfo
from .run_logger import RunLogger

LONG_SECONDS = 60  # after a longer iteration there is always a checkpoint
GRACE_SECONDS = 4  # for an update to end after SIGTERM; short, to leave time for a checkpoint


class Trainer:
    """The training of a run, with its environments and its open files."""

    def __init__(self, config: Config, directory: RunDirectory | FollowerDirectory):
        """Build everything that can raise a ConfigError; compile nothing yet.

        Args:
          config: a valid configuration.
          directory: the directory of the run, locked.

        Raises:
          ConfigError: the task or the checkpoint does not fit the configuration.
        """
        enable_compilation_cache()
        settings = apply_debug_settings()
        self.config, self.seeds = config, config.seeds
        self.placement = choose_placement(config)
        self.logger = RunLogger(config, directory, self.placement)
        self.logger.messages += settings
        self.experiment = build_experiment(config, self.placement, self.logger.done)
        self.collector = self.experiment.make_collector()
        self.train_step = self.placement.compile_train_step(self.experiment.make_train_step())
        self.update: Any = None  # the compiled train_step
        self.copy = jax.jit(partial(jax.tree.map, jnp.copy))
        # None: not initialized yet, or donated to a running update.
        self.state: sndjax.TrainState | None = self.logger.load(self.experiment.state_shapes())
        self.update_seconds: float | None = None  # the expected time of an update
        self.logger.open_tracker()

    def train(self, interrupts: Interrupts) -> None:
        """Run all remaining iterations, and log each.

        Args:
          interrupts: the signals that this process receives.

        Raises:
          NonFiniteError: with on_nan=stop, a number is not finite.
          Interrupted: a signal was received.
          OSError: the files of the run cannot be written.
          TaskError: the environment failed.
        """
        self.interrupts = interrupts
        config, logger = self.config, self.logger
        total = config.iterations * config.rows
        logger.open_logs(self.experiment.agent, self.experiment.pool.rooms)
        title = f"{config.env.name} {config.algo.name}, {len(self.seeds)} seed(s) -> {logger.path}"
        self.progress = Progress(title, total, logger.done * config.rows)
        reader = self.experiment.pool.reader
        news = announcements(config, self.experiment.agent, reader, logger.done)
        for line in [*logger.messages, *news]:
            self.progress.say(line)
        logger.say = self.progress.say
        finished = False
        try:
            try:
                self.iterate()
            except BaseException as error:  # whatever it is, the last finished iteration stays
                if self.placement.hosts == 1 or isinstance(error, Interrupted):
                    self.save_before_leaving()
                # A signal to all processes of the run may have ended those of the environment.
                if isinstance(error, TaskError) and interrupts.wait_for_signal():
                    raise Interrupted(interrupts.received or signal.SIGTERM) from error
                raise
            finished = True
            logger.logs.summarize(logger.done * config.rows)
            self.progress.say(f"finished: {logger.path}")
        finally:
            self.progress.close()
            logger.close(finished)
            self.collector.close()

    def iterate(self) -> None:
        """Run every iteration from the next one to the last one."""
        config, progress, logger = self.config, self.progress, self.logger
        if logger.done == config.iterations:
            return
        progress.phase("compiling the policy")
        if self.state is None:
            self.state = self.placement.put_states(self.experiment.init_states())
            logger.save(self.state)  # so that there is always a checkpoint to resume from
        pool = self.experiment.pool
        self.episodes = EpisodeTracker(self.seeds, config.num_envs, pool.rooms)
        self.monitors = {seed: HealthMonitor(pool.num_actions) for seed in self.seeds}
        for line in logger.logs.read_back():
            self.monitors[line["seed"]].update(line)  # these warnings were printed before
        while logger.done < config.iterations:
            self.run_iteration()
            self.check()
        logger.save(self.state)
        progress.phase("saving")
        logger.flush()

    def run_iteration(self) -> None:
        """Collect a rollout, learn from it, log it; save a checkpoint if one is due."""
        config, progress, logger = self.config, self.progress, self.logger
        begun = time.monotonic()
        batch, info = self.collect()
        collected = time.monotonic()
        metrics, int_reward = self.learn(batch, info)
        assert self.state is not None
        elapsed = time.monotonic() - begun
        times = {
            "steps_per_second": config.rows / elapsed,
            "collect_seconds": collected - begun,
            "update_seconds": self.update_seconds,
        }
        logger.logs.wall_seconds += elapsed
        ended = self.episodes.update(
            logger.done * config.rows,
            info.valid,
            info.game_over,
            (info.reward, info.score, int_reward),
            info.room,
        )
        lines = logger.log(info, metrics, ended, times)
        progress.iteration(mean_over_seeds(lines))
        for line in lines:
            for warning in self.monitors[line["seed"]].update(line):
                progress.say(warning)
        if logger.checkpoint_due(elapsed > LONG_SECONDS):
            logger.save(self.state)
            self.check()
            logger.write_snapshot(self.state, batch, int_reward)

    def check(self) -> None:
        """Raise Interrupted if any host received a signal, so that all hosts stop together.

        Raises:
          Interrupted: a signal was received.
        """
        if self.placement.any_host(self.interrupts.received is not None):
            raise Interrupted(self.interrupts.received or signal.SIGTERM)

    def collect(self) -> tuple[sndjax.Experience, RolloutInfo]:
        """Collect the next rollout.

        Returns:
          The batch for `train_step`, and the data for the log, of all hosts.

        Raises:
          Interrupted: a signal was received.
        """
        assert self.state is not None
        self.progress.phase("collecting")

        def stepped(step: int) -> None:
            self.interrupts.begin()  # the policy is compiled: from here on `check` is called often
            if self.placement.hosts == 1:  # several hosts stop together, after an iteration
                self.interrupts.check()
            self.progress.within(step / self.config.rollout_length)

        actor = sndjax.Actor(self.state.policy, self.state.observations, self.state.key)
        batch, info = self.collector.collect(actor, stepped)
        return self.placement.put_batch(batch), self.placement.gather_hosts(info)

    def learn(
        self, batch: sndjax.Experience, info: RolloutInfo
    ) -> tuple[dict[str, list[float]], np.ndarray]:
        """Update the state of every seed.

        Args:
          batch: the rollout of all seeds.
          info: the data for the log, for the check of the rewards.

        Returns:
          The metrics by name, a value for every seed, and the intrinsic rewards, [S, T, N].

        Raises:
          NonFiniteError: with on_nan=stop, a number is not finite.
          Interrupted: a signal was received.
        """
        state = self.state
        assert state is not None
        if self.update is None:
            self.compile(state, batch)
        # The update reuses the state's memory. A copy must remain, on the disk or here.
        on_disk = self.logger.checkpoints.newest == self.logger.done and self.placement.hosts == 1
        before = None if on_disk else self.copy(state)
        self.progress.phase("learning", self.update_seconds)
        begun = time.monotonic()
        try:
            with self.breakable(GRACE_SECONDS):
                self.state = None
                state, found, reward = jax.block_until_ready(self.update(state, batch))
        except BaseException:
            self.state = before
            raise
        self.update_seconds = time.monotonic() - begun
        metrics = {name: np.asarray(value).tolist() for name, value in found.items()}
        # Of several hosts, none can read the frames of all.
        frames = batch.rollout.frames if self.placement.hosts == 1 else None
        wrong = nonfinite_terms(self.seeds, info.reward, info.valid, metrics, frames)
        if wrong and self.config.on_nan == "stop":
            self.state, message = keep_failed_update(
                self.logger, self.experiment, wrong, before, batch
            )
            raise NonFiniteError(message)
        metrics.pop("state_finite", None)
        self.state = state
        return metrics, np.asarray(reward)

    def breakable(self, grace: float = 0.0) -> AbstractContextManager[None]:
        """Return a context in which a signal interrupts waiting, if this is the only host."""
        return self.interrupts.waiting(grace) if self.placement.hosts == 1 else nullcontext()

    def compile(self, state: sndjax.TrainState, batch: sndjax.Experience) -> None:
        """Compile the update, and estimate its time."""
        if jit_is_disabled():
            self.update = self.train_step
            return
        self.progress.phase("compiling the update")
        begun = time.monotonic()
        with self.breakable():
            traced = self.train_step.trace(state, batch)
            self.update = traced.lower().compile()
        self.update_seconds = estimate_seconds(traced.jaxpr.jaxpr)
        return_freed_memory()
        each = format_duration(self.update_seconds)
        compiled = f"update compiled in {time.monotonic() - begun:.0f} s"
        self.progress.say(f"{compiled}; each takes about {each}")

    def save_before_leaving(self) -> None:
        """Save a checkpoint of the last logged iteration.

        None is saved if an interrupted update has its memory, or the state is newer than the log.
        """
        self.progress.phase("saving")
        try:
            if self.state is not None:
                self.logger.save(self.state)
            self.logger.flush()
        except Exception as error:  # what ended the run is raised, not this
            self.progress.say(f"no checkpoint could be written: {error}")


def train(
    config: Config, directory: RunDirectory | FollowerDirectory, interrupts: Interrupts
) -> None:
    """Train the agents of a configuration in a run directory, or resume the run that is there.

    Args:
      config: a valid configuration.
      directory: the directory of the run, locked.
      interrupts: the signals that this process receives.

    Raises:
      ConfigError: the task or the checkpoint does not fit the configuration; nothing was written.
      NonFiniteError: with on_nan=stop, a number is not finite.
      Interrupted: a signal was received.
      OSError: the files of the run cannot be written.
      TaskError: the environment failed.
    """
    trainer = Trainer(config, directory)
    trainer.logger.messages += directory.begin(config, versions())
    trainer.train(interrupts)
