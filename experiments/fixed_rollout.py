"""python -m experiments.fixed_rollout env=Venture algo=snd_std: one rollout, learned ten times.

Collects one real rollout with the policy as it starts, then lets the motivation module alone
learn from it for ten updates. Whether a module learns at all is seen here, with nothing else
moving. Takes the options of `experiments.run` that make an agent and its environments.
"""

import sys
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import sndjax
from experiments.agents import build, first_states, over_seeds
from experiments.collect import Collector
from experiments.config import load
from experiments.environments import make_pool
from experiments.options import ConfigError
from experiments.process import keep_compilations
from experiments.run import refuse
from sndjax.train import train_module

UPDATES = 10


def rollout_of(config: Any) -> tuple[sndjax.Agent, sndjax.TrainState, sndjax.Experience]:
    """The agent of a configuration at its start, and its first rollout."""
    pool = make_pool(config.env, [config.seed], config.num_envs)
    agent = build(config, pool)
    example = np.zeros((config.num_envs, *pool.shape), pool.dtype)
    states = first_states(agent, [config.seed], example)
    act = jax.jit(over_seeds(partial(sndjax.act, agent), 1, shared=1))
    heads = agent.network.value_heads
    collector = Collector([pool], act, config.env.stack, config.rollout_length, heads)
    batch, _ = collector.collect(sndjax.Actor(states.policy, states.observations, states.key))
    state, batch = jax.tree.map(
        lambda x: jnp.asarray(x[0]) if isinstance(x, np.ndarray) else x[0], (states, batch)
    )
    return agent, state, batch


def main(arguments: list[str]) -> int:
    """Print the module's losses, a line an update: means over its minibatches."""
    try:
        config = load(arguments)
        if config.algo.name == "ppo":
            raise ConfigError("algo=ppo has no module that learns")
        if config.resume or config.run_dir or config.num_seeds > 1:
            raise ConfigError("one fresh agent and no run directory: no resume, run_dir, num_seeds")
        keep_compilations()
        agent, state, batch = rollout_of(config)
    except ConfigError as error:
        return refuse(error)
    assert agent.motivation is not None
    module, rollout = agent.motivation.module, batch.rollout
    _, moved = jax.jit(module.reward)(state.intrinsic, state.intrinsic_state, rollout, state.key)
    state = state._replace(intrinsic_state=moved)  # moments have seen the rollout, as in a run
    update = jax.jit(lambda state, key: train_module(agent, state, batch, key))
    index = jnp.arange(config.algo.minibatch_size)

    @jax.jit
    def loss(params, state, key):
        """Of the signal, on the first minibatch."""
        rows = sndjax.transitions(rollout, index)
        metrics = module.loss(params, state, rows, rollout, key)[1]
        return metrics.get("distillation_loss", metrics.get("prediction_loss"))

    copies = [state.intrinsic["signal"]]
    for i, key in enumerate(jax.random.split(state.key, UPDATES)):
        state, metrics = update(state, key)
        copies.append(state.intrinsic["signal"])
        shown = "  ".join(
            f"{k} {float(v):.4g}" for k, v in metrics.items() if "loss" in k or "spread" in k
        )
        print(f"update {i + 1}  {shown}", flush=True)
    if loss(state.intrinsic, state.intrinsic_state, key) is not None:
        values = [
            float(loss(state.intrinsic | {"signal": copy}, state.intrinsic_state, key))
            for copy in copies
        ]
        print("against the encoder as it is now: " + " ".join(f"{v:.4g}" for v in values))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
