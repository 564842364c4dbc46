"""The training loop of a run: rollout -> train_step -> log, for every iteration."""

import signal
from functools import partial

import jax
import jax.numpy as jnp

import sndjax

from ..config.schema import Config
from ..storage.episodes import EpisodeTracker
from ..storage.run_directory import FollowerDirectory, RunDirectory
from ..storage.run_logs import mean_over_seeds
from ..system.display import Progress
from ..system.errors import NonFiniteError, TaskError
from ..system.interrupts import Interrupted, Interrupts
from ..system.jax_settings import apply_debug_settings
from ..system.process import enable_compilation_cache
from ..system.versions import versions
from .cpu_cores import use_cores
from .device_mesh import choose_placement
from .diagnostics import HealthMonitor, announcements
from .experiment import RunState, build_experiment
from .fused_iterations import FusedIterations
from .iterations import HostIterations, IterationResult, Iterations, Watch
from .nonfinite import keep_failed_update, nonfinite_terms
from .placement import overlap_message
from .run_logger import RunLogger
from .run_states import load_run_state, resume_run_state, trees_beside

LONG_SECONDS = 60  # after a longer iteration there is always a checkpoint


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
        use_cores(config)
        settings = apply_debug_settings()
        self.config, self.seeds = config, config.seeds
        placement = choose_placement(config)
        self.logger = RunLogger(config, directory, placement)
        self.logger.messages += settings
        self.experiment = build_experiment(config, placement, self.logger.done)
        self.placement = self.logger.placement = self.experiment.placement
        self.logger.messages += overlap_message(config, self.placement)
        pool = self.experiment.pool
        self.fused = pool.environment is not None
        self.episodes = EpisodeTracker(self.seeds, config.num_envs, pool.rooms)
        self.collector = None if self.fused else self.experiment.make_collector()
        self.copy = jax.jit(partial(jax.tree.map, jnp.copy))
        # None: not initialized yet, or donated to a running update.
        self.state = resume_run_state(self.logger, self.experiment, self.episodes)
        self.logger.open_tracker()

    def save(self, state: RunState) -> None:
        """Start to write a checkpoint.

        Raises:
          OSError: the logs or the previous checkpoint could not be written.
        """
        self.logger.save(state.train, trees_beside(state, self.experiment, self.episodes))

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
        pool, agent = self.experiment.pool, self.experiment.agent
        logger.open_logs(agent, pool.rooms)
        title = f"{config.env.name} {config.algo.name}, {len(self.seeds)} seed(s) -> {logger.path}"
        self.progress = Progress(title, total, logger.done * config.rows)
        news = announcements(config, agent, pool.reader, logger.done)
        for line in [*logger.messages, *news]:
            self.progress.say(line)
        logger.say = self.progress.say
        watch = Watch(self.progress, interrupts, self.placement.hosts)
        self.iterations: Iterations = (
            FusedIterations(self.experiment, watch)
            if self.collector is None
            else HostIterations(self.experiment, self.collector, watch, logger.done)
        )
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
            if self.collector is not None:
                self.collector.close()

    def iterate(self) -> None:
        """Run every iteration from the next one to the last one."""
        config, progress, logger = self.config, self.progress, self.logger
        if logger.done == config.iterations:
            return
        if self.state is None:
            self.state = self.experiment.init_run()
            self.save(self.state)  # so that there is always a checkpoint to resume from
        actions = self.experiment.pool.num_actions
        self.monitors = {seed: HealthMonitor(actions) for seed in self.seeds}
        for line in logger.logs.read_back():
            self.monitors[line["seed"]].update(line)  # these warnings were printed before
        while logger.done < config.iterations:
            self.advance()
            self.check()
        self.save(self.state)
        progress.phase("saving")
        logger.flush()

    def advance(self) -> None:
        """Run some iterations and log them; save a checkpoint if one is due.

        Raises:
          NonFiniteError: with on_nan=stop, a number is not finite.
          Interrupted: a signal was received.
        """
        config, logger, state = self.config, self.logger, self.state
        assert state is not None
        every = config.checkpoint_every
        most = min(config.iterations - logger.done, every - logger.done % every)
        results, batch = self.take_iterations(state, most)
        for result in results:
            self.log(result)
        state = self.state
        assert state is not None
        late = sum(result.seconds for result in results) > LONG_SECONDS
        if logger.checkpoint_due(late):
            self.save(state)
            self.check()
            logger.write_snapshot(state.train, batch, results[-1].int_reward)

    def take_iterations(
        self, state: RunState, most: int
    ) -> tuple[list[IterationResult], sndjax.Experience]:
        """Run some iterations, and return their results and the last rollout.

        Args:
          state: of all seeds; its memory is reused.
          most: the number of iterations that may be run.

        Raises:
          NonFiniteError: with on_nan=stop, a number is not finite; iterations before it are logged.
          Interrupted: a signal was received.
        """
        # A copy must remain, on the disk or here.
        on_disk = self.logger.checkpoints.newest == self.logger.done and self.placement.hosts == 1
        before = None if on_disk else self.copy(state)
        self.state = None
        try:
            state, results, batch = self.iterations.run(state, most)
        except BaseException:
            self.state = before
            raise
        if self.config.on_nan == "stop":
            self.check_finite(results, before, batch)
        self.state = state
        return results, batch

    def log(self, result: IterationResult) -> None:
        """Log one iteration."""
        config, logger = self.config, self.logger
        info = result.info
        logger.logs.wall_seconds += result.seconds
        times = {"steps_per_second": config.rows / result.seconds} | result.parts
        ended = self.episodes.update(
            logger.done * config.rows,
            info.valid,
            info.game_over,
            (info.reward, info.score, result.int_reward),
            info.room,
        )
        result.metrics.pop("state_finite", None)
        lines = logger.log(info, result.metrics, ended, times)
        self.progress.iteration(mean_over_seeds(lines))
        for line in lines:
            for warning in self.monitors[line["seed"]].update(line):
                self.progress.say(warning)

    def check_finite(
        self, results: list[IterationResult], before: RunState | None, batch: sndjax.Experience
    ) -> None:
        """Save what led to a number that is not finite, if there is one.

        Args:
          results: of the last call.
          before: the state before it; None if the newest checkpoint holds it.
          batch: the last rollout of the call.

        Raises:
          NonFiniteError: there is one.
        """
        fine = [
            not nonfinite_terms(self.seeds, result.info.reward, result.info.valid, result.metrics)
            for result in results
        ]
        if all(fine):
            return
        load_newest = partial(
            load_run_state, self.logger.checkpoints, self.experiment, self.episodes
        )
        i = fine.index(False)
        first = before  # before the iterations that are logged now
        if first is None and i > 0:
            first = load_newest()
        for result in results[:i]:
            self.log(result)

        def recover() -> tuple[RunState, sndjax.Experience]:
            return self.iterations.repeat(first or load_newest(), i, batch)

        self.state, message = keep_failed_update(
            self.logger, self.experiment, results[i], recover, self.save
        )
        raise NonFiniteError(message)

    def check(self) -> None:
        """Raise Interrupted if any host received a signal, so that all hosts stop together.

        Raises:
          Interrupted: a signal was received.
        """
        if self.placement.any_host(self.interrupts.received is not None):
            raise Interrupted(self.interrupts.received or signal.SIGTERM)

    def save_before_leaving(self) -> None:
        """Save a checkpoint of the last logged iteration.

        None is saved if an interrupted update has its memory, or the state is newer than the log.
        """
        self.progress.phase("saving")
        try:
            if self.state is not None:
                self.save(self.state)
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
