"""The run itself: pool -> rollout -> train_step -> log, iteration after iteration."""

import signal
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import sndjax
from experiments.agents import build, first_states, make_train_step, over_seeds
from experiments.checkpoint import Damaged
from experiments.collect import Collector, Track, groups_of
from experiments.devices import layout
from experiments.directory import Directory, Elsewhere
from experiments.environments import make_pools
from experiments.episodes import Episodes
from experiments.estimate import seconds
from experiments.interrupts import Interrupted, Interrupts
from experiments.journal import Journal
from experiments.options import Config, ConfigError
from experiments.process import keep_compilations, return_freed_memory
from experiments.progress import Progress, clock
from experiments.records import mean_line
from experiments.symptoms import Signs, dump, not_finite
from experiments.versions import versions

WIDE = ("re3", "e3b", "ngu")  # signals whose unit is not that of a squared feature
LONG_SECONDS = 60  # an iteration that takes longer is always followed by a checkpoint
GRACE_SECONDS = 4  # that an update may go on after SIGTERM, so that its checkpoint is in time


class Run:
    """A run and what it holds open."""

    def __init__(self, config: Config, directory: Directory | Elsewhere):
        """Prepare everything that can refuse the configuration; compile nothing yet."""
        keep_compilations()
        self.config, self.seeds = config, config.seeds
        self.layout = layout(config)
        self.journal = Journal(config, directory, self.layout)
        mine = self.layout.envs(config.num_envs)
        groups = self.layout.groups(groups_of(config.num_envs), config.num_envs)
        pools = make_pools(config.env, self.seeds, config.num_envs, self.journal.done, groups, mine)
        self.pool = pools[0]
        self.agent = build(config, self.pool)
        example = jnp.zeros((config.num_envs, *self.pool.shape), self.pool.dtype)
        self.fresh = lambda: first_states(self.agent, self.seeds, example)
        try:
            jax.eval_shape(partial(sndjax.init, self.agent), jax.random.key(0), example)
        except ValueError as error:  # an objective that this environment has nothing for
            raise ConfigError(f"algo={config.algo.name}: {error}") from None
        own = partial(sndjax.act, self.agent)
        act = self.layout.act(over_seeds(own, config.num_seeds, 1, self.layout.axis))
        heads, stack = self.agent.network.value_heads, config.env.stack
        self.collector = Collector(
            pools, act, stack, config.rollout_length, heads, self.layout.frames
        )
        self.train_step = self.layout.learn(make_train_step(self.agent, config, self.layout))
        self.update: Any = None  # the compiled train_step
        self.copy = jax.jit(partial(jax.tree.map, jnp.copy))
        # None: not made yet, or in an update.
        self.state: sndjax.TrainState | None = self.journal.load(jax.eval_shape(self.fresh))
        self.expected: float | None = None  # seconds of an update
        self.journal.track()

    def train(self, interrupts: Interrupts) -> None:
        """Train to the last iteration, logging each."""
        self.interrupts = interrupts
        config, journal = self.config, self.journal
        total = config.iterations * config.rows
        journal.open(self.agent, self.pool.rooms)
        title = f"{config.env.name} {config.algo.name}, {len(self.seeds)} seed(s) -> {journal.path}"
        self.progress = Progress(title, total, journal.done * config.rows)
        for line in [*journal.said, *self.announcements()]:
            self.progress.say(line)
        journal.say = self.progress.say
        finished = False
        try:
            try:
                self.iterate()
            except Interrupted:
                self.save_before_leaving()
                raise
            finished = True
            journal.records.summarize(journal.done * config.rows)
            self.progress.say(f"finished: {journal.path}")
        finally:
            self.progress.close()
            journal.close(finished)
            self.collector.close()

    def announcements(self) -> Iterator[str]:
        """What there is to know before the first iteration."""
        algo = self.config.algo
        if algo.signal in WIDE and algo.reward_scale == "none":
            yield (
                f"the signal {algo.signal} has no published scale: unless its share of clipped "
                "rewards stays low, take algo.reward_scale=running_std"
            )
        if 0 < self.journal.done < self.config.iterations:
            yield f"going on from iteration {self.journal.done}; environments begin new episodes"

    def iterate(self) -> None:
        """From the iteration the run stands at to its last."""
        config, progress, journal = self.config, self.progress, self.journal
        if journal.done == config.iterations:
            return
        progress.phase("compiling the policy")
        if self.state is None:
            self.state = self.layout.states(self.fresh())
            journal.save(self.state)  # so that there is always one to go on from
        episodes = Episodes(self.seeds, config.num_envs, self.pool.rooms)
        signs = {seed: Signs(self.pool.num_actions) for seed in self.seeds}
        for line in journal.records.past():
            signs[line["seed"]].take_in(line)  # what it says was said
        while journal.done < config.iterations:
            begun = time.monotonic()
            batch, track = self.collect()
            collected = time.monotonic()
            metrics, int_reward = self.learn(batch, track)
            gone = time.monotonic() - begun
            times = {
                "steps_per_second": config.rows / gone,
                "collect_seconds": collected - begun,
                "update_seconds": self.expected,
            }
            journal.records.wall_seconds += gone
            ended = episodes.take_in(
                journal.done * config.rows,
                track.valid,
                track.done,
                (track.reward, track.score, int_reward),
                track.room,
            )
            lines = journal.log(track, metrics, ended, times)
            progress.iteration(mean_line(lines))
            for line in lines:
                for warning in signs[line["seed"]].take_in(line):
                    progress.say(warning)
            if journal.due(gone > LONG_SECONDS):
                journal.save(self.state)
                self.check()
                journal.look(self.state, batch, int_reward)
            self.check()
        journal.save(self.state)
        progress.phase("saving")
        journal.settle()

    def check(self) -> None:
        """A point where the run can stop; several hosts stop together."""
        if self.layout.any(self.interrupts.received is not None):
            raise Interrupted(self.interrupts.received or signal.SIGTERM)

    def collect(self) -> tuple[sndjax.Experience, Track]:
        """The next rollout."""
        assert self.state is not None
        self.progress.phase("collecting")

        def stepped(step: int) -> None:
            self.interrupts.begin()  # the policy is compiled: from here on a check is never far
            if self.layout.hosts == 1:  # several stop together, after an iteration
                self.interrupts.check()
            self.progress.within(step / self.config.rollout_length)

        actor = sndjax.Actor(self.state.policy, self.state.observations, self.state.key)
        batch, track = self.collector.collect(actor, stepped)
        return self.layout.batch(batch), self.layout.everywhere(track)

    def learn(
        self, batch: sndjax.Experience, track: Track
    ) -> tuple[dict[str, list[float]], np.ndarray]:
        """Update every seed's state; their metrics and intrinsic rewards, [S, ...].

        Raises:
          FloatingPointError: with on_nan=stop, a number is not finite.
        """
        state = self.state
        assert state is not None
        if self.update is None:
            self.compile(state, batch)
        # The update uses the state's memory again. On the disk or here, one copy stays.
        kept = self.journal.checkpoints.newest == self.journal.done and self.layout.hosts == 1
        before = None if kept else self.copy(state)
        self.progress.phase("learning", self.expected)
        begun = time.monotonic()
        try:
            with self.breakable(GRACE_SECONDS):
                self.state = None
                state, found, reward = jax.block_until_ready(self.update(state, batch))
        except Interrupted:
            self.state = before
            raise
        self.expected = time.monotonic() - begun
        metrics = {name: np.asarray(value).tolist() for name, value in found.items()}
        wrong = not_finite(self.seeds, track.reward, track.valid, metrics)
        if wrong and self.config.on_nan == "stop":
            raise FloatingPointError(self.went_wrong(wrong, before, batch))
        metrics.pop("state_finite", None)
        self.state = state
        return metrics, np.asarray(reward)

    def breakable(self, grace: float = 0.0) -> AbstractContextManager[None]:
        """Inside, a signal breaks off the wait; not of one host, while others wait for it."""
        return self.interrupts.waiting(grace) if self.layout.hosts == 1 else nullcontext()

    def compile(self, state: sndjax.TrainState, batch: sndjax.Experience) -> None:
        """Compile the update, and estimate how long one takes."""
        self.progress.phase("compiling the update")
        begun = time.monotonic()
        with self.breakable():
            traced = self.train_step.trace(state, batch)
            self.update = traced.lower().compile()
        self.expected = seconds(traced.jaxpr.jaxpr)
        return_freed_memory()
        self.progress.say(
            f"update compiled in {time.monotonic() - begun:.0f} s; "
            f"each takes about {clock(self.expected)}"
        )

    def went_wrong(
        self, wrong: list[str], before: sndjax.TrainState | None, batch: sndjax.Experience
    ) -> str:
        """Leave what is needed to see what went wrong and to go on from before it; say where."""
        more = f" (and {len(wrong) - 1} more)" if len(wrong) > 1 else ""
        journal = self.journal
        said = f"iteration {journal.done + 1}, {wrong[0]}{more}"
        where = journal.path / f"wrong-{journal.done + 1}"
        try:
            if before is None:
                before = journal.standing(jax.eval_shape(self.fresh))
            self.state = before
            journal.save(before)
            journal.settle()
            before, batch = self.layout.whole((before, batch))
            if self.layout.leads:
                dump(where, self.config, versions(), before, batch)
        except (OSError, Damaged) as error:
            return f"{said}; what it came from could not be kept: {error}"
        return (
            f"{said}; the last good checkpoint is that of iteration {journal.done}; to see why: "
            f"python -m experiments.replay {where}"
        )

    def save_before_leaving(self) -> None:
        """A checkpoint of this moment, unless the state is inside an update that was broken off."""
        self.progress.phase("saving")
        try:
            if self.state is not None:
                self.journal.save(self.state)
            self.journal.settle()
        except OSError as error:
            self.progress.say(f"no checkpoint of this moment: {error}")


def train(config: Config, directory: Directory | Elsewhere, interrupts: Interrupts) -> None:
    """Train the configuration in its directory, or go on with what is there.

    Raises:
      ConfigError: the task or the checkpoint refuses the configuration; nothing was written yet.
      FloatingPointError: a number is not finite.
      Interrupted: by a signal.
      OSError: the run cannot be written.
    """
    run = Run(config, directory)
    run.journal.said += directory.begin(config, versions())
    run.train(interrupts)
