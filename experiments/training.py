"""The run itself: pool -> rollout -> train_step -> log, iteration after iteration."""

import os
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

import sndjax
from experiments.checkpoint import Checkpoints
from experiments.collect import Collector
from experiments.directory import Directory
from experiments.environments import Pool, make_pool
from experiments.episodes import Episodes
from experiments.estimate import seconds
from experiments.extension import load_module
from experiments.interrupts import Interrupts
from experiments.options import COPYING, AlgoConfig, Config, ConfigError
from experiments.process import return_freed_memory
from experiments.progress import Progress, clock
from experiments.records import Records
from experiments.versions import versions
from sndjax.algorithms import NAMED

WIDE = ("re3", "e3b", "ngu")  # signals whose unit is not that of a squared feature
CHECKPOINT_SECONDS = 300  # and at least this often, however long an iteration takes


def keep_compilations() -> None:
    """Turn on jax's compilation cache, so that the next run of the same sizes starts at once."""
    default = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "sndjax" / "jax"
    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_compilation_cache_dir", str(default))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def motivation_of(algo: AlgoConfig, num_actions: int, size: sndjax.Architecture) -> Any:
    """The motivation of a configuration, or None for the baseline.

    Raises:
      ConfigError: this cell refuses this environment, or the user's module is none.
    """
    own: dict[str, Any] = {"preprocess": algo.preprocess, "activation": algo.activation}
    if algo.signal in COPYING:
        own["pairing"] = algo.pairing
    if algo.signal == "prediction":
        own["gradient"] = algo.gradient
    if algo.name == "ppo":
        return None
    if algo.module is not None:
        make = partial(load_module, algo.module)
        own = {}
    elif algo.name == "grid":
        make = partial(sndjax.grid, algo.objective, algo.signal)
    else:
        make = cast(Any, NAMED[algo.name])
    return sndjax.Motivation(
        make(num_actions, size, **own),
        algo.eta,
        cast(Any, algo.reward_scale),  # one of the choices: it was validated
        algo.learning_rate,
        algo.minibatch_size,
        algo.shuffle,
    )


def build(config: Config, pool: Pool) -> sndjax.Agent:
    """The agent of a configuration for the frames and actions of a pool."""
    if pool.dtype != np.uint8:
        size = sndjax.VECTOR
    else:
        size = sndjax.ATARI if pool.shape[-1] == 1 else sndjax.PROCGEN
    motivation = motivation_of(config.algo, pool.num_actions, size)
    return sndjax.Agent(
        sndjax.ActorCritic(size, pool.num_actions, 2 if motivation else 1),
        sndjax.Hyperparameters(**asdict(config.ppo)),
        motivation,
        sndjax.Stack(config.env.stack, config.env.repeat_first),
        pool.unbounded,
        config.env.random_action,
    )


def over_seeds(function: Callable[..., Any], seeds: int, shared: int = 0) -> Callable[..., Any]:
    """A function of leaves [S, ...]: mapped over seeds, its last `shared` arguments the same.

    One seed is not mapped but squeezed: a batch axis of one costs time on a CPU.
    """
    if seeds > 1:
        return lambda *args: jax.vmap(function, [0] * (len(args) - shared) + [None] * shared)(*args)

    def single(*args):
        own, same = args[: len(args) - shared], args[len(args) - shared :]
        result = function(*jax.tree.map(lambda x: x[0], own), *same)
        return jax.tree.map(lambda x: x[None], result)

    return single


def first_states(agent: sndjax.Agent, seeds: list[int], example: Any) -> sndjax.TrainState:
    """The state of every seed before its first iteration, leaves [S, ...].

    One seed after another: under vmap the orthogonal weights become a batched QR
    decomposition, and two of those at once deadlock jaxlib 0.10.2 on a CPU of two cores (each
    holds a thread of the pool and waits there for the other's).
    """
    init = jax.jit(partial(sndjax.init, agent))
    states = [init(jax.random.key(seed), example) for seed in seeds]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)


def rss_mb() -> float:
    """Resident memory of this process, in MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


class Run:
    """A run and what it holds open."""

    def __init__(self, config: Config, directory: Directory):
        """Prepare everything that can refuse the configuration; compile nothing yet."""
        keep_compilations()
        self.config, self.directory = config, directory
        self.seeds = [config.seed + i for i in range(config.num_seeds)]
        count = config.num_seeds
        self.checkpoints = Checkpoints(directory.path)
        start = (self.checkpoints.manager.latest_step() or 0) if directory.resumed else 0
        self.pool = make_pool(config.env, self.seeds, config.num_envs, start)
        self.agent = build(config, self.pool)
        example = jnp.zeros((config.num_envs, *self.pool.shape), self.pool.dtype)
        self.fresh = lambda: first_states(self.agent, self.seeds, example)
        try:
            jax.eval_shape(partial(sndjax.init, self.agent), jax.random.key(0), example)
        except ValueError as error:  # an objective that this environment has nothing for
            raise ConfigError(f"algo={config.algo.name}: {error}") from None
        self.act = jax.jit(over_seeds(partial(sndjax.act, self.agent), count, shared=1))
        self.train_step = jax.jit(
            over_seeds(sndjax.make_train_step(self.agent), count), donate_argnums=0
        )
        self.state: sndjax.TrainState | None = None
        self.start = 0
        if directory.resumed:
            found = self.checkpoints.restore(jax.eval_shape(self.fresh))
            if found is not None:
                self.start, self.state = found

    def train(self) -> None:
        """Train to the last iteration, logging each."""
        config, path, rows = self.config, self.directory.path, self.config.rows
        total = config.iterations * rows
        records = Records(path, self.seeds, self.pool.rooms, self.start * rows)
        title = f"{config.env.name} {config.algo.name}, {len(self.seeds)} seed(s) -> {path}"
        progress = Progress(title, total, self.start * rows)
        try:
            if self.start < config.iterations:
                with Interrupts() as interrupts:
                    self.iterations(records, progress, interrupts)
            records.summarize(total)
            progress.say(f"finished: {path}")
        finally:
            progress.close()
            records.close()
            self.checkpoints.close()
            self.pool.close()

    def iterations(self, records: Records, progress: Progress, interrupts: Interrupts) -> None:
        """From the iteration the run stands at to its last."""
        config, rows = self.config, self.config.rows
        if config.algo.signal in WIDE and config.algo.reward_scale == "none":
            progress.say(
                f"the signal {config.algo.signal} has no published scale: unless its share of "
                "clipped rewards stays low, take algo.reward_scale=running_std"
            )
        if self.start:
            progress.say(f"going on from iteration {self.start}; environments begin new episodes")
        progress.phase("compiling the policy")
        state = self.fresh() if self.state is None else self.state
        heads = self.agent.network.value_heads
        collector = Collector(self.pool, self.act, config.env.stack, config.rollout_length, heads)
        episodes = Episodes(self.seeds, config.num_envs, self.pool.rooms)
        update, expected = None, None
        skip = int(config.env.options.get("frame_skip", 1))
        saved = time.monotonic()

        def stepped(step: int) -> None:
            interrupts.check()
            progress.within(step / config.rollout_length)

        for iteration in range(self.start, config.iterations):
            begun = time.monotonic()
            progress.phase("collecting")
            batch, track = collector.collect(
                sndjax.Actor(state.policy, state.observations, state.key), stepped
            )
            collected = time.monotonic()
            if update is None:
                progress.phase("compiling the update")
                with interrupts.waiting():
                    traced = self.train_step.trace(state, batch)
                    update = traced.lower().compile()
                expected = seconds(traced.jaxpr.jaxpr)
                return_freed_memory()
                progress.say(
                    f"update compiled in {time.monotonic() - collected:.0f} s; "
                    f"each takes about {clock(expected)}"
                )
            progress.phase("learning", expected)
            learning = time.monotonic()
            with interrupts.waiting():
                state, metrics, int_reward = jax.block_until_ready(update(state, batch))
            expected = time.monotonic() - learning
            gone = time.monotonic() - begun
            records.wall_seconds += gone
            ended = episodes.take_in(
                iteration * rows,
                batch.rollout.valid,
                batch.rollout.done,
                (batch.reward, track.score, np.asarray(int_reward)),
                track.room,
            )
            metrics = {name: np.asarray(value).tolist() for name, value in metrics.items()}
            valid = batch.rollout.valid.sum((1, 2)).tolist()
            lines = []
            for i in range(len(self.seeds)):
                records.transitions[i] += valid[i]
                entry = {
                    "iteration": iteration + 1,
                    "step": (iteration + 1) * rows,
                    "transitions": records.transitions[i],
                    "frames": (iteration + 1) * rows * skip,
                    **{name: value[i] for name, value in metrics.items()},
                    "steps_per_second": rows / gone,
                    "collect_seconds": collected - begun,
                    "update_seconds": expected,
                    "wall_seconds": records.wall_seconds,
                    "rss_mb": rss_mb(),
                }
                lines.append(records.take_in(i, ended[i], entry))
            records.flush()
            progress.iteration(mean_line(lines))
            last = iteration + 1 == config.iterations
            due = (iteration + 1) % config.checkpoint_every == 0
            if last or due or time.monotonic() - saved > CHECKPOINT_SECONDS:
                progress.phase("saving")
                self.checkpoints.save(iteration + 1, state)
                records.summarize((iteration + 1) * rows)
                saved = time.monotonic()


def mean_line(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """The mean over seeds of every figure that is there for any."""
    mean = {}
    for key in lines[0]:
        values = [line[key] for line in lines if line[key] is not None]
        mean[key] = sum(values) / len(values) if values else None
    return mean | {"step": lines[0]["step"]}


def train(config: Config, directory: Directory) -> None:
    """Train the configuration in its directory, or go on with what is there.

    Raises:
      ConfigError: the task or the checkpoint refuses the configuration; nothing was written yet.
    """
    run = Run(config, directory)
    directory.begin(config, versions())
    run.train()
