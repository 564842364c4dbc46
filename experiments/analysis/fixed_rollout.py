"""Repeated training of the intrinsic module on one rollout, to see whether it learns."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import sndjax
from sndjax.updates import update_intrinsic_module

from ..config.schema import Config
from ..system.errors import ConfigError
from ..system.process import enable_compilation_cache
from ..training.experiment import build_experiment


def collect_one_rollout(
    config: Config,
) -> tuple[sndjax.AgentSpec, sndjax.TrainState, sndjax.Experience]:
    """Return the untrained agent of a configuration, its state and its first rollout."""
    experiment = build_experiment(config)
    states = experiment.init_states()
    collector = experiment.make_collector()
    batch, _ = collector.collect(sndjax.Actor(states.policy, states.observations, states.key))
    collector.close()
    state, batch = jax.tree.map(
        lambda x: jnp.asarray(x[0]) if isinstance(x, np.ndarray) else x[0], (states, batch)
    )
    return experiment.agent, state, batch


def make_signal_loss(
    module: sndjax.IntrinsicModule, rollout: sndjax.Rollout, rows: int
) -> Callable[..., Any]:
    """Make a jitted function (params, state, key) -> the signal's loss, or None without one.

    Args:
      module: the intrinsic module.
      rollout: the rollout that the module is trained on.
      rows: the number of rows, from the first, that the loss is computed on.
    """
    batch = sndjax.gather_transitions(rollout, jnp.arange(rows))

    @jax.jit
    def loss(params: Any, state: Any, key: jax.Array) -> jax.Array | None:
        metrics = module.loss(params, state, batch, rollout, key)[1]
        return metrics.get("distillation_loss", metrics.get("prediction_loss"))

    return loss


def learn_fixed_rollout(config: Config, updates: int) -> None:
    """Train the module repeatedly on one rollout, and print its losses.

    Args:
      config: the configuration of one fresh agent.
      updates: the number of updates.

    Raises:
      ConfigError: the configuration has no module, names a run, or has several seeds.
    """
    if config.algo.name == "ppo":
        raise ConfigError("algo=ppo has no module that learns")
    if config.resume or config.run_dir or config.num_seeds > 1:
        raise ConfigError("one fresh agent and no run directory: no resume, run_dir, num_seeds")
    enable_compilation_cache()
    agent, state, batch = collect_one_rollout(config)
    assert agent.intrinsic is not None
    module, rollout = agent.intrinsic.module, batch.rollout
    _, module_state = jax.jit(module.reward)(
        state.intrinsic, state.intrinsic_state, rollout, state.key
    )
    # The input statistics include the rollout, as in a run.
    state = state._replace(intrinsic_state=module_state)
    update = jax.jit(lambda state, key: update_intrinsic_module(agent, state, batch, key))
    loss = make_signal_loss(module, rollout, config.algo.minibatch_size)
    copies = [state.intrinsic.signal]
    for i, key in enumerate(jax.random.split(state.key, updates)):
        learned, metrics = update(state, key)
        state = state._replace(**learned._asdict())
        copies.append(state.intrinsic.signal)
        shown = "  ".join(
            f"{k} {float(v):.4g}" for k, v in metrics.items() if "loss" in k or "spread" in k
        )
        print(f"update {i + 1}  {shown}", flush=True)
    if loss(state.intrinsic, state.intrinsic_state, key) is not None:
        values = [
            float(loss(state.intrinsic._replace(signal=copy), state.intrinsic_state, key))
            for copy in copies
        ]
        print("against the encoder as it is now: " + " ".join(f"{v:.4g}" for v in values))
