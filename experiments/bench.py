"""python -m experiments.bench env=Venture algo=snd_std: where the time of a run goes.

Takes the options of `experiments.run`. Each phase of an iteration is timed on some of its
minibatches and scaled up, so that a table is there in minutes; with --whole a real iteration is
timed beside it. The last line is one JSON object with the same figures.
"""

import json
import resource
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.compilation_cache import compilation_cache

import sndjax
from experiments.agents import build, first_states, make_train_step, over_seeds
from experiments.collect import Collector, groups_of
from experiments.config import load
from experiments.environments import make_pools
from experiments.nominal import total
from experiments.options import Config, ConfigError
from experiments.process import before_jax, keep_compilations
from experiments.run import refuse
from experiments.timing import Clock, processor, say
from experiments.versions import versions
from sndjax.train import advantages, clean, intrinsic_reward, train_module, train_policy

MINIBATCHES = 3  # that a phase is timed on: a call's start costs a tenth of one
PHASES = ("environment", "acting", "rewards", "policy", "motivation")


def short_length(config: Config) -> int:
    """Steps of the rollout that phases are timed on: the fewest that give `MINIBATCHES` of each."""
    sizes = (config.ppo.minibatch_size, config.algo.minibatch_size)
    for steps in range(1, config.rollout_length + 1):
        rows = steps * config.num_envs
        if rows >= MINIBATCHES * max(sizes) and not any(rows % size for size in sizes):
            return steps
    return config.rollout_length


def cut(batch: sndjax.Experience, steps: int) -> sndjax.Experience:
    """The first steps of a batch."""
    rollout = batch.rollout._replace(frames=batch.rollout.frames[: steps + 1])
    rollout = rollout._replace(**{n: getattr(rollout, n)[:steps] for n in rollout._fields[1:]})
    own = {n: getattr(batch, n)[:steps] for n in ("reward", "truncated", "log_prob")}
    return batch._replace(rollout=rollout, value=batch.value[: steps + 1], **own)


class Bench:
    """An agent with its environments, and one rollout of them."""

    def __init__(self, config: Config):
        """Make everything, and collect one rollout."""
        self.clock = Clock()
        self.clock.time_product()  # compiled here, and not counted
        self.clock.products.clear()
        self.config, seeds = config, config.seeds
        groups = groups_of(config.num_envs)
        pools = make_pools(config.env, seeds, config.num_envs, groups=groups)
        self.pool = pools[0]
        self.agent = build(config, self.pool)
        example = jnp.zeros((config.num_envs, *self.pool.shape), self.pool.dtype)
        self.states = first_states(self.agent, seeds, example)
        act = over_seeds(partial(sndjax.act, self.agent), config.num_seeds, shared=1)
        self.act = jax.jit(act)
        heads = self.agent.network.value_heads
        stack, length = config.env.stack, config.rollout_length
        self.collector = Collector(pools, self.act, stack, length, heads)
        self.batch, _ = self.collector.collect(self.actor())

    def actor(self) -> sndjax.Actor:
        """Who acts now."""
        return sndjax.Actor(self.states.policy, self.states.observations, self.states.key)

    def phase_seconds(self) -> dict[str, float]:
        """Seconds of each phase in a whole iteration, from some of its steps and minibatches."""
        config, agent = self.config, self.agent
        steps = short_length(config)
        times = config.rollout_length / steps
        groups = self.collector.groups
        rows = (config.num_seeds, config.num_envs // len(groups))
        draw = np.random.default_rng(0)
        actions = draw.integers(0, self.pool.num_actions, (steps, *rows), np.int32)
        frame, actor = self.pool.reset(), self.actor()
        window = np.zeros((rows[0], config.env.stack, *frame.shape[1:]), self.pool.dtype)
        first = np.ones(rows, bool)

        def stepping():
            for chosen in actions:
                for group in groups:
                    group.pool.send(chosen)
                for group in groups:
                    group.pool.receive()

        def acting():
            kept: Any = window
            for t in range(steps):
                for _ in groups:
                    decision, kept = self.act(actor, kept, frame, first, np.int32(t))
                    np.asarray(decision.executed)

        # One after the other; with two pools a run does them at once.
        found = {"environment": times * self.clock.seconds(stepping)}
        found["acting"] = times * (1 + 1 / config.rollout_length) * self.clock.seconds(acting)
        epochs = min(2, config.ppo.epochs)
        shorter = agent._replace(ppo=agent.ppo._replace(epochs=epochs))

        def rewards(state, batch):
            return intrinsic_reward(agent, state, clean(cut(batch, steps)), state.key)[1]

        def policy(state, batch):
            batch = clean(cut(batch, steps))
            estimate = advantages(agent.ppo, batch, jnp.zeros_like(batch.reward))
            return train_policy(shorter, state, batch, *estimate, state.key)[0]

        def motivation(state, batch):
            return train_module(agent, state, clean(cut(batch, steps)), state.key)[0]

        for name, phase, counted in (
            ("rewards", rewards, times),
            ("policy", policy, times * config.ppo.epochs / epochs),
            ("motivation", motivation, times),
        ):
            found[name] = 0.0
            if agent.motivation is None and name != "policy":
                continue
            say(f"timing {name}")
            found[name] = counted * self.repeated(over_seeds(phase, config.num_seeds), name)
        return found

    def repeated(self, phase: Callable[..., Any], name: str) -> float:
        """The seconds of a jitted phase; a state that is trained goes on to the next."""
        learns = name != "rewards"
        compiled = jax.jit(phase, donate_argnums=0 if learns else ())

        def work():
            result = compiled(self.states, self.batch)
            if learns:
                self.states = result
            return result

        return self.clock.seconds(work)

    def compile_update(self) -> tuple[Any, float, float]:
        """The whole update, and the seconds that compiling it takes without the cache and with."""
        step = jax.jit(make_train_step(self.agent, self.config), donate_argnums=0)
        gone = []
        for cached in (False, True, True):  # the first with the cache may have to fill it
            jax.config.update("jax_enable_compilation_cache", cached)
            compilation_cache.reset_cache()  # jax asks once whether there is one
            jax.clear_caches()  # and keeps what it compiled
            begun = time.perf_counter()
            compiled = step.lower(self.states, self.batch).compile()
            gone.append(time.perf_counter() - begun)
        return compiled, gone[0], gone[2]

    def whole_seconds(self, update: Any) -> tuple[float, float]:
        """Collecting and learning of one real iteration, after one that does not count."""
        for _ in range(2):
            begun = time.perf_counter()
            batch, _ = self.collector.collect(self.actor())
            collected = time.perf_counter()
            self.states, _, _ = jax.block_until_ready(update(self.states, batch))
            learned = time.perf_counter()
        return collected - begun, learned - collected


def nominal(config: Config, agent: sndjax.Agent, shape: tuple[int, ...]) -> float | None:
    """10^9 operations per environment step, worked out by hand; None where nobody did."""
    if config.algo.module is not None:
        return None
    work = total(
        None if config.algo.name == "ppo" else config.algo.objective,
        config.algo.signal,
        agent.network.architecture,
        shape,
        config.env.stack,
        agent.network.num_actions,
        config.ppo.epochs,
        config.algo.minibatch_size,
        config.algo.name == "qrnd",
    )
    return None if work is None else work / 1e9


def measure(config: Config, whole: bool) -> dict[str, Any]:
    """Everything that is printed."""
    say(f"{config.env.name} {config.algo.name}: matrix product, environments, a rollout")
    bench = Bench(config)
    phases = bench.phase_seconds()
    say("compiling the whole update, without the cache and with")
    update, compile_seconds, cached_seconds = bench.compile_update()
    steps = config.rows * config.num_seeds
    gone = sum(phases.values())
    measured: dict[str, Any] = {
        "env": config.env.name,
        "algo": config.algo.name,
        "platform": jax.default_backend(),
        "device": processor(),
        "num_seeds": config.num_seeds,
        "num_envs": config.num_envs,
        "rollout_length": config.rollout_length,
        "steps_per_second": steps / gone,
        "seconds_per_1000_steps": {n: 1000 * phases[n] / steps for n in PHASES},
        "compile_seconds": compile_seconds,
        "compile_seconds_cached": cached_seconds,
    }
    if whole:
        say(f"timing two whole iterations, about {gone:.0f} s each")
        collecting, learning = bench.whole_seconds(update)
        measured["whole_steps_per_second"] = steps / (collecting + learning)
        measured["whole_collecting_share"] = collecting / (collecting + learning)
        measured["phases_over_whole"] = gone / (collecting + learning)
    rate, work = bench.clock.gflops(), nominal(config, bench.agent, bench.pool.shape)
    bench.collector.close()
    return measured | {
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6,
        "matmul_gflops": rate,
        "nominal_gflop_per_step": work,
        "share_of_peak": None if work is None else measured["steps_per_second"] * work / rate,
        "versions": versions(),
    }


def table(measured: dict[str, Any]) -> str:
    """The figures for a person."""
    per_1000 = measured["seconds_per_1000_steps"]
    whole = sum(per_1000.values())
    lines = [f"{'phase':<14}{'s / 1,000 steps':>16}{'share':>8}"]
    for name, seconds in per_1000.items():
        lines.append(f"{name:<14}{seconds:>16.3f}{seconds / whole:>8.1%}")
    lines.append(f"{'all of it':<14}{whole:>16.3f}{'100%':>8}")
    share = measured["share_of_peak"]
    lines += [
        f"{measured['steps_per_second']:,.1f} steps/s on {measured['device']}",
        f"compiling the update {measured['compile_seconds']:.0f} s, from the cache "
        f"{measured['compile_seconds_cached']:.1f} s, peak memory "
        f"{measured['peak_rss_mb']:,.0f} MB",
        f"matrix product {measured['matmul_gflops']:.0f} GFLOP/s"
        + (
            ""
            if share is None
            else f"; {measured['nominal_gflop_per_step']:.2f} GFLOP of nominal work a step: "
            f"{share:.2f} of that"
        ),
    ]
    if "phases_over_whole" in measured:
        lines.append(
            f"a whole iteration: {measured['whole_steps_per_second']:,.1f} steps/s; the phases' "
            f"sum is {measured['phases_over_whole']:.3f} of it"
        )
    return "\n".join(lines)


def main(arguments: list[str]) -> int:
    """Print the table and the JSON object."""
    if {"-h", "--help"} & set(arguments):
        print(__doc__)
        return 0
    whole = "--whole" in arguments
    try:
        config = load([a for a in arguments if a != "--whole"])
        if config.resume or config.run_dir:
            raise ConfigError("a benchmark writes no run: no resume, no run_dir")
        keep_compilations()
        measured = measure(config, whole)
    except ConfigError as error:
        return refuse(error)
    say(table(measured))
    say(json.dumps(measured))
    return 0


if __name__ == "__main__":
    before_jax()
    sys.exit(main(sys.argv[1:]))
