"""The time of each phase of an iteration, measured on some of its minibatches."""

import json
import resource
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.compilation_cache import compilation_cache

import sndjax
from sndjax.ppo import compute_advantages
from sndjax.rollout import zero_reset_rows
from sndjax.train import compute_intrinsic_rewards
from sndjax.updates import update_intrinsic_module, update_policy

from ..config.library import has_action_input
from ..config.schema import Config
from ..system.errors import ConfigError
from ..system.jax_settings import at_precision
from ..system.process import enable_compilation_cache
from ..system.versions import versions
from ..training.cpu_cores import use_cores
from ..training.experiment import build_experiment
from ..training.scan_collector import ScanCollector
from ..training.seeds import map_over_seeds
from .analytic_flops import flops_per_step
from .phase_table import phase_table
from .timing import BenchmarkTimer, device_name, print_line
from .whole_iterations import measure_whole

WHOLE = 2  # iterations that are timed as a run takes them, after two that are not
MINIBATCHES = 3  # that a phase is timed on; the start of a call costs a tenth of one


def timed_steps(config: Config, pixels: bool) -> int:
    """Return the length of the rollout that is timed: the shortest with `MINIBATCHES` of each.

    Args:
      config: of the benchmark.
      pixels: whether observations are images; for vectors the whole rollout is timed.
    """
    if not pixels:
        return config.rollout_length
    sizes = (config.ppo.minibatch_size, config.algo.minibatch_size)
    for steps in range(1, config.rollout_length + 1):
        rows = steps * config.num_envs
        if rows >= MINIBATCHES * max(sizes) and not any(rows % size for size in sizes):
            return steps
    return config.rollout_length


def first_steps(batch: sndjax.Experience, steps: int) -> sndjax.Experience:
    """Return the first `steps` steps of a batch."""
    rollout = batch.rollout._replace(frames=batch.rollout.frames[: steps + 1])
    rollout = rollout._replace(**{n: getattr(rollout, n)[:steps] for n in rollout._fields[1:]})
    own = {n: getattr(batch, n)[:steps] for n in ("reward", "truncated", "log_prob")}
    return batch._replace(rollout=rollout, value=batch.value[: steps + 1], **own)


class PhaseBenchmark:
    """An agent with its environments, and one rollout of them."""

    def __init__(self, config: Config):
        """Build the agent and its environments, and collect one rollout."""
        self.timer = BenchmarkTimer()
        self.timer.time_product()  # compiled here, and not counted
        self.timer.products.clear()
        self.config = config
        # On one device, also where jax has more for overlap=1.
        self.experiment = build_experiment(replace(config, cores=1))
        self.agent = self.experiment.agent
        self.states = self.experiment.init_states()
        self.collector = self.experiment.make_collector()
        self.batch, _ = self.collector.collect(self.actor())

    def actor(self) -> sndjax.Actor:
        """Return the part of the current states that is needed to act."""
        return sndjax.Actor(self.states.policy, self.states.observations, self.states.key)

    def phase_seconds(self) -> dict[str, float]:
        """Estimate the seconds of each phase of an iteration from some steps and minibatches."""
        pixels = self.experiment.pool.dtype == np.uint8
        steps = timed_steps(self.config, pixels)
        found = self.collecting_seconds(steps)
        config, agent = self.config, self.agent
        times = config.rollout_length / steps
        epochs = min(2, config.ppo.epochs) if pixels else config.ppo.epochs
        for name, phase, counted in (
            ("rewards", self.rewards_phase(steps), times),
            ("policy", self.policy_phase(steps, epochs), times * config.ppo.epochs / epochs),
            ("motivation", self.module_phase(steps), times),
        ):
            found[name] = 0.0
            if agent.intrinsic is None and name != "policy":
                continue
            print_line(f"timing {name}")
            found[name] = counted * self.repeated(map_over_seeds(phase, config.num_seeds), name)
        return found

    def collecting_seconds(self, steps: int) -> dict[str, float]:
        """Time stepping and acting one after the other; in a run with two pools they overlap.

        Where both are one program, as for environments in JAX, it is timed as a whole.
        """
        config = self.config
        if isinstance(self.collector, ScanCollector):
            collect = self.collector.collect
            return {"collecting": self.timer.seconds(lambda: collect(self.actor()))}
        times = config.rollout_length / steps
        collector, pool = self.collector, self.experiment.pool
        pool_states, actor = collector.pool_states, self.actor()
        rows = (config.num_seeds, config.num_envs // len(pool_states))
        draw = np.random.default_rng(0)
        actions = draw.integers(0, pool.num_actions, (steps, *rows), np.int32)

        def stepping() -> None:
            for chosen in actions:
                for state in pool_states:
                    state.pool.send(chosen)
                for state in pool_states:
                    state.pool.receive()

        def acting() -> None:
            for t in range(steps):
                for k in range(len(pool_states)):
                    collector.acting.local_rows(collector.act(k, actor, t))

        found = {"environment": times * self.timer.seconds(stepping)}
        collector.open_rollout()
        found["acting"] = times * (1 + 1 / config.rollout_length) * self.timer.seconds(acting)
        collector.take_records()
        return found

    def rewards_phase(self, steps: int) -> Callable[..., Any]:
        """Return a function of one seed that computes intrinsic rewards of a short rollout."""

        def rewards(state: sndjax.TrainState, batch: sndjax.Experience) -> Any:
            batch = zero_reset_rows(first_steps(batch, steps))
            return compute_intrinsic_rewards(self.agent, state, batch, state.key)[1]

        return rewards

    def policy_phase(self, steps: int, epochs: int) -> Callable[..., Any]:
        """Return a function of one seed that runs some PPO epochs on a short rollout."""
        agent = self.agent
        shorter = agent._replace(ppo=agent.ppo._replace(epochs=epochs))

        def policy(state: sndjax.TrainState, batch: sndjax.Experience) -> Any:
            batch = zero_reset_rows(first_steps(batch, steps))
            estimate = compute_advantages(agent.ppo, batch, jnp.zeros_like(batch.reward))
            learned, _ = update_policy(shorter, state, batch, *estimate, state.key)
            return state._replace(**learned._asdict())

        return policy

    def module_phase(self, steps: int) -> Callable[..., Any]:
        """Return a function of one seed that trains the intrinsic module on a short rollout."""

        def module(state: sndjax.TrainState, batch: sndjax.Experience) -> Any:
            batch = zero_reset_rows(first_steps(batch, steps))
            learned, _ = update_intrinsic_module(self.agent, state, batch, state.key)
            return state._replace(**learned._asdict())

        return module

    def repeated(self, phase: Callable[..., Any], name: str) -> float:
        """Time a jitted phase; a trained state is the input of the next repetition."""
        learns = name != "rewards"
        compiled = jax.jit(
            at_precision(self.config.precision, phase), donate_argnums=0 if learns else ()
        )

        def work() -> Any:
            result = compiled(self.states, self.batch)
            if learns:
                self.states = result
            return result

        return self.timer.seconds(work)

    def compile_seconds(self) -> tuple[float, float]:
        """Compile the update; return the seconds without and with the compilation cache."""
        step = jax.jit(self.experiment.make_train_step(), donate_argnums=0)
        gone = []
        for cached in (False, True, True):  # the first with the cache may fill it
            jax.config.update("jax_enable_compilation_cache", cached)
            compilation_cache.reset_cache()  # jax checks only once whether there is a cache
            jax.clear_caches()  # compiled programs are also kept in memory
            begun = time.perf_counter()
            step.lower(self.states, self.batch).compile()
            gone.append(time.perf_counter() - begun)
        return gone[0], gone[2]


def config_gflop_per_step(
    config: Config, agent: sndjax.AgentSpec, shape: tuple[int, ...]
) -> float | None:
    """Return 10^9 analytic operations per environment step; None where they were not derived.

    Args:
      config: the configuration of the run.
      agent: the agent, for its networks.
      shape: the shape of a frame.
    """
    if config.algo.module is not None:
        return None
    work = flops_per_step(
        None if config.algo.name == "ppo" else config.algo.objective,
        config.algo.signal,
        agent.network.architecture,
        shape,
        config.env.stack,
        agent.network.num_actions,
        config.ppo.epochs,
        config.algo.minibatch_size,
        has_action_input(config.algo.name),
    )
    return None if work is None else work / 1e9


def measure(config: Config, whole: bool) -> dict[str, Any]:
    """Measure a configuration, and return all figures."""
    if config.overlap:
        use_cores(config)
    print_line(f"{config.env.name} {config.algo.name}: matrix product, environments, a rollout")
    bench = PhaseBenchmark(config)
    phases = bench.phase_seconds()
    print_line("compiling the whole update, without the cache and with")
    compile_seconds, cached_seconds = bench.compile_seconds()
    steps = config.rows * config.num_seeds
    gone = sum(phases.values())
    measured: dict[str, Any] = {
        "env": config.env.name,
        "algo": config.algo.name,
        "platform": jax.default_backend(),
        "device": device_name(),
        "num_seeds": config.num_seeds,
        "num_envs": config.num_envs,
        "rollout_length": config.rollout_length,
        "steps_per_second": steps / gone,
        "seconds_per_1000_steps": {n: 1000 * gone / steps for n, gone in phases.items()},
        "compile_seconds": compile_seconds,
        "compile_seconds_cached": cached_seconds,
    }
    if whole:
        print_line(f"timing whole iterations, about {gone:.0f} s each")
        measured |= measure_whole(config, gone, WHOLE)
    rate, work = (
        bench.timer.gflops(),
        config_gflop_per_step(config, bench.agent, bench.experiment.pool.shape),
    )
    bench.collector.close()
    return measured | {
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6,
        "matmul_gflops": rate,
        "nominal_gflop_per_step": work,
        "share_of_peak": None if work is None else measured["steps_per_second"] * work / rate,
        "versions": versions(),
    }


def print_benchmark(config: Config, whole: bool) -> None:
    """Measure a configuration, and print the table and the JSON object.

    Raises:
      ConfigError: the configuration names a run.
    """
    if config.resume or config.run_dir:
        raise ConfigError("a benchmark writes no run: no resume, no run_dir")
    enable_compilation_cache()
    measured = measure(config, whole)
    print_line(phase_table(measured))
    print_line(json.dumps(measured))
