"""Many agents in one program, each with numbers of its own: a scale, learning rates.

Such numbers are arguments of the compiled program, so that a search compiles once for all settings
of the same shapes.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sndjax

from ..config.schema import Config
from ..training.agents import make_init_states, make_seed_train_step
from ..training.experiment import START_STREAM, Experiment, build_experiment
from ..training.fused_iterations import visit_metrics
from ..training.policy_lag import actor_of
from ..training.scan_collector import make_jax_collect
from ..training.seeds import map_over_seeds


class Curve(NamedTuple):
    """What a population did, a value for every agent and iteration: float[S, iterations].

    Attributes:
      episodes: that ended.
      solved: those with a positive score.
      coverage: the distinct places that were visited so far; 0 where the task has none.
      progress: the mean progress of all episodes so far.
    """

    episodes: np.ndarray
    solved: np.ndarray
    coverage: np.ndarray
    progress: np.ndarray


def with_numbers(agent: sndjax.AgentSpec, numbers: dict[str, Any]) -> sndjax.AgentSpec:
    """Return an agent with other numbers, which may be traced.

    Args:
      agent: the agent.
      numbers: by the option's name; those of `algo` are the intrinsic module's.
    """
    of = lambda group: {
        name.partition(".")[2]: value for name, value in numbers.items() if name.startswith(group)
    }
    intrinsic = agent.intrinsic and agent.intrinsic._replace(**of("algo."))
    return agent._replace(ppo=agent.ppo._replace(**of("ppo.")), intrinsic=intrinsic)


def make_training(experiment: Experiment) -> Any:
    """Return a function of one agent that trains it from its start to its end, not jitted.

    Args:
      experiment: of environments in jax.

    Returns:
      (state, numbers) -> `Curve` of the agent, leaves [iterations].
    """
    config, env = experiment.config, experiment.pool.environment
    assert env is not None

    def train(state: sndjax.TrainState, numbers: dict[str, Any]) -> Any:
        agent = with_numbers(experiment.agent, numbers)
        collect = make_jax_collect(env, agent, config)
        train_step = make_seed_train_step(agent, config)
        key = jax.random.fold_in(state.key, START_STREAM)
        live = sndjax.init_environments(env, key, config.num_envs, config.env.stack, agent.network)

        def iterate(carry: Any, _: Any) -> Any:
            state, live, total = carry
            batch, live, score = collect(actor_of(state), live)
            state, *_ = train_step(state, batch)

            # `total` is the score of the running episodes.
            def count(total: Any, row: Any) -> Any:
                score, done = row
                total = total + score
                return jnp.where(done, 0, total), (total > 0) & done

            total, solved = jax.lax.scan(count, total, (score, batch.rollout.done))
            seen = visit_metrics(live.visits) or {"coverage": 0, "progress": 0.0}
            row = Curve(batch.rollout.done.sum(), solved.sum(), seen["coverage"], seen["progress"])
            return (state, live, total), jax.tree.map(jnp.float32, row)

        start = (state, live, jnp.zeros(config.num_envs))
        return jax.lax.scan(iterate, start, length=config.iterations)[1]

    return train


class Population:
    """Agents of one program: all that they have in common is compiled once."""

    def __init__(self, config: Config):
        """Build environments and agents; compile nothing yet.

        Args:
          config: of environments in jax; its number of seeds is how many agents train together.
        """
        self.size = config.num_seeds
        self.experiment = build_experiment(config)
        self.init = make_init_states(self.experiment.agent)
        self.program = jax.jit(map_over_seeds(make_training(self.experiment), self.size))

    def train(self, seeds: list[int], numbers: dict[str, list[float]]) -> Curve:
        """Train agents side by side, each from its seed and with its numbers.

        Args:
          seeds: one for each agent.
          numbers: by the option's name, a value for each agent.
        """
        given = {name: jnp.asarray(values, jnp.float32) for name, values in numbers.items()}
        states = self.init(seeds, self.experiment.example)
        return Curve(*map(np.asarray, self.program(states, given)))
