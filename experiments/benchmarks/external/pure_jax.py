"""PureJaxRL's PPO beside ours: the same networks, environments and minibatches, in one process."""

import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax

import sndjax
from sndjax.acting import forward

from ...config.compose import load_config
from ...environments.jax_pool import JaxPool
from ...environments.pools import env_seeds
from ...system.errors import ConfigError
from ...system.versions import versions
from ...training.agents import make_intrinsic_config
from ..timing import device_name, print_line

ROUNDS = 5
ACTIONS = 3
# What both do, by the script's names. Only the reward differs: theirs is the task's own.
SETTINGS: dict[str, Any] = {
    "LR": 5e-4,
    "NUM_ENVS": 32,
    "NUM_STEPS": 128,
    "UPDATE_EPOCHS": 4,
    "NUM_MINIBATCHES": 32,
    "GAMMA": 0.99,
    "GAE_LAMBDA": 0.95,
    "CLIP_EPS": 0.1,
    "ENT_COEF": 0.001,
    "VF_COEF": 0.5,
    "MAX_GRAD_NORM": 0.5,
    "ACTIVATION": "relu",
    "ENV_NAME": "MountainCar-v0",
    "ANNEAL_LR": False,
}


class SameStepResets:
    """An environment of gymnax with the interface that the script expects: five results a step."""

    def __init__(self, env: Any):
        self.env = env

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def step(self, key: Any, state: Any, action: Any, params: Any) -> tuple[Any, ...]:
        """Take a step; an environment that ends is reset in the same step.

        Args:
          key: of the draws.
          state: before.
          action: of the policy.
          params: of the environment.
        """
        frame, state, reward, ended, cut, _ = self.env.step(key, state, action, params)
        return frame, state, reward, ended | cut, {}


class OurNetwork:
    """Our policy with the interface of the script's `ActorCritic`."""

    def __init__(self, action_dim: int, activation: str):
        """Make the network; its activation is ours."""
        self.network = sndjax.ActorCritic(sndjax.VECTOR, action_dim, 1)

    def init(self, key: Any, frame: Any) -> Any:
        """Return weights for a frame without a batch axis."""
        return self.network.init(key, frame[None])

    def apply(self, params: Any, frames: Any) -> tuple[Any, Any]:
        """Return the distribution of actions, and the values, of a batch."""
        import distrax

        logits, value = forward(self.network, params, frames)
        return distrax.Categorical(logits=logits), value[:, 0]


def peer_objects() -> dict[str, Any]:
    """Return our objects by the names that they replace in the script.

    Raises:
      ImportError: gymnax is not installed.
    """
    import gymnax

    def make(name: str) -> tuple[Any, Any]:
        env, params = gymnax.make(name)
        return SameStepResets(env), params

    same = lambda env: env  # the script's wrappers log, which is not timed
    return {
        "gymnax": SimpleNamespace(make=make),
        "LogWrapper": same,
        "FlattenObservationWrapper": same,
        "ActorCritic": OurNetwork,
    }


def our_program(settings: dict[str, Any], algo: str, updates: int) -> Callable[[Any], Any]:
    """Return our training of the same work as a function of a key, not jitted.

    Args:
      settings: those of the script.
      algo: `ppo`, or a bonus on top of it.
      updates: the number of iterations.
    """
    envs, steps = settings["NUM_ENVS"], settings["NUM_STEPS"]
    rows = envs * steps // settings["NUM_MINIBATCHES"]
    config = load_config(
        ["env=MountainCar", "env.suite=gymnax", f"algo={algo}", f"num_envs={envs}"]
        + [f"rollout_length={steps}", f"ppo.minibatch_size={rows}"]
        + ([] if algo == "ppo" else [f"algo.minibatch_size={rows}"])
    )
    env = JaxPool(config.env, [env_seeds(0, envs, 0)]).environment
    assert env is not None
    intrinsic = make_intrinsic_config(config, ACTIONS, sndjax.VECTOR)
    agent = sndjax.AgentSpec(
        network=sndjax.ActorCritic(sndjax.VECTOR, ACTIONS, 2 if intrinsic else 1),
        ppo=sndjax.Hyperparameters(
            learning_rate=settings["LR"],
            minibatch_size=rows,
            epochs=settings["UPDATE_EPOCHS"],
            clip=settings["CLIP_EPS"],
            gamma_ext=settings["GAMMA"],
            gae_lambda=settings["GAE_LAMBDA"],
            entropy_weight=settings["ENT_COEF"],
            value_weight=settings["VF_COEF"],
            max_grad_norm=settings["MAX_GRAD_NORM"],
            normalize_advantages=True,
        ),
        intrinsic=intrinsic,
    )
    train_step = sndjax.make_train_step(agent)

    def iterate(carry: Any, _: Any) -> tuple[Any, Any]:
        state, live = carry
        actor = sndjax.Actor(state.policy, state.observations, state.key)
        key = jax.random.fold_in(state.key, 2)
        batch, live = sndjax.collect(agent, env, actor, live, key, steps)
        state, metrics, _ = train_step(state, batch)
        return (state, live), metrics

    def train(key: Any) -> Any:
        live = sndjax.init_environments(env, key, envs)
        state = sndjax.init_train_state(agent, key, live.frame)
        return jax.lax.scan(iterate, (state, live), None, length=updates)

    return train


def compare_speed(
    script: str, steps: int, changes: dict[str, Any], adapt: Callable[..., Any], out: Path
) -> None:
    """Time the script's training and ours in turn, print a table, and write it as JSON.

    Args:
      script: the text of the script.
      steps: the steps that each training takes.
      changes: settings other than `SETTINGS`.
      adapt: compiles a script with our objects in place of its own.
      out: the directory of the figures.

    Raises:
      ConfigError: a setting is unknown, or the file is another script.
      ImportError: a package is not installed.
    """
    if unknown := set(changes) - set(SETTINGS):
        raise ConfigError(f"settings: {', '.join(sorted(unknown))}: known: {', '.join(SETTINGS)}")
    settings = SETTINGS | changes
    ours = peer_objects()
    names: dict[str, Any] = ours | {"__name__": "peer"}
    exec(adapt(script, ours, 1), names)
    updates = max(1, steps // (settings["NUM_ENVS"] * settings["NUM_STEPS"]))
    taken = updates * settings["NUM_ENVS"] * settings["NUM_STEPS"]
    theirs = names["make_train"](settings | {"TOTAL_TIMESTEPS": taken})
    programs = {"PureJaxRL's PPO": theirs}
    programs |= {f"our {algo}": our_program(settings, algo, updates) for algo in ("ppo", "rnd")}
    key, compiled, compiling = jax.random.key(0), {}, {}
    for name, train in programs.items():
        begun = time.perf_counter()
        compiled[name] = jax.jit(train).lower(key).compile()
        compiling[name] = time.perf_counter() - begun
        print_line(f"{name}: compiled in {compiling[name]:.0f} s")
    gone: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(ROUNDS):
        for name, train in compiled.items():
            begun = time.perf_counter()
            jax.block_until_ready(train(key))
            gone[name].append(time.perf_counter() - begun)
    rates = {name: taken / statistics.median(seconds) for name, seconds in gone.items()}
    first = next(iter(rates.values()))
    print_line(f"{'':<18}{'steps/s':>10}{'to the first':>14}{'lowest':>10}{'highest':>10}")
    for name, rate in rates.items():
        low, high = taken / max(gone[name]), taken / min(gone[name])
        print_line(f"{name:<18}{rate:>10,.0f}{rate / first:>14.2f}{low:>10,.0f}{high:>10,.0f}")
    out.mkdir(parents=True, exist_ok=True)
    found = {
        "steps_per_second": rates,
        "seconds": gone,
        "compile_seconds": compiling,
        "settings": settings,
        "device": device_name(),
        "versions": versions(),
    }
    (out / "purejaxrl.json").write_text(json.dumps(found, indent=1) + "\n")
