"""Many agents in one program, each with numbers of its own: a scale, learning rates.

Such numbers are arguments of the compiled program, so that a search compiles once for all settings
of the same shapes.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import sndjax

from ..config.schema import Config
from ..training.agents import make_init_states, make_seed_train_step
from ..training.experiment import Experiment, build_experiment
from ..training.fused_iterations import visit_metrics
from ..training.policy_lag import actor_of
from ..training.scan_collector import make_jax_collect
from ..training.seeds import map_over_seeds


class Curve(NamedTuple):
    """What a population did, a value for every agent and iteration: float[S, iterations].

    Attributes:
      episodes: that ended.
      solved: those with a positive score.
      coverage: the distinct places that were visited so far.
      progress: the mean progress of all episodes so far.
      finite: 1 where every number of the agent is finite.
    """

    episodes: np.ndarray
    solved: np.ndarray
    coverage: np.ndarray
    progress: np.ndarray
    finite: np.ndarray


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


class Agent(NamedTuple):
    """An agent in the middle of its training."""

    train: sndjax.TrainState
    environments: sndjax.LiveEnvironments
    score: Float[Array, " N"]  # of the running episodes


def count_solved(score: Any, rewards: Any, done: Any) -> tuple[Any, Any]:
    """Return the scores of the running episodes after a rollout, and how many ended above 0.

    Args:
      score: before it, [N].
      rewards: of the rollout, [T, N].
      done: where an episode ended, [T, N].
    """

    def step(score: Any, row: tuple[Any, Any]) -> Any:
        reward, ended = row
        score = score + reward
        return jnp.where(ended, 0, score), ((score > 0) & ended).sum()

    score, solved = jax.lax.scan(step, score, (rewards, done))
    return score, solved.sum()


def make_training(experiment: Experiment, iterations: int) -> Callable[..., tuple[Agent, Curve]]:
    """Return a function that trains one agent for some iterations, not jitted.

    Args:
      experiment: of environments in jax, with places.
      iterations: their number.

    Returns:
      (agent, numbers) -> the agent after them, and its `Curve`, leaves [iterations].
    """
    config, env = experiment.config, experiment.pool.environment
    assert env is not None

    def train(agent: Agent, numbers: dict[str, Any]) -> tuple[Agent, Curve]:
        spec = with_numbers(experiment.agent, numbers)
        collect = make_jax_collect(env, spec, config)
        train_step = make_seed_train_step(spec, config)

        def iterate(agent: Agent, _: Any) -> tuple[Agent, Curve]:
            batch, live, reward = collect(actor_of(agent.train), agent.environments)
            state, metrics, _ = train_step(agent.train, batch)
            score, solved = count_solved(agent.score, reward, batch.rollout.done)
            seen = visit_metrics(live.visits)
            row = Curve(
                episodes=batch.rollout.done.sum(),
                solved=solved,
                coverage=seen["coverage"],
                progress=seen["progress"],
                finite=metrics["state_finite"],
            )
            return Agent(state, live, score), jax.tree.map(jnp.float32, row)

        return jax.lax.scan(iterate, agent, length=iterations)

    return train


class Population:
    """Agents of one program: all that they have in common is compiled once."""

    def __init__(self, config: Config, parts: int = 1):
        """Build environments and agents; compile nothing yet.

        Args:
          config: of environments in jax; its number of seeds is how many agents train together.
          parts: in how many calls of the program they are trained.
        """
        self.size = config.num_seeds
        self.experiment = build_experiment(config)
        self.init = make_init_states(self.experiment.agent)
        each = config.iterations // parts
        self.begin = jax.jit(self.experiment.init_environments)
        self.program = jax.jit(map_over_seeds(make_training(self.experiment, each), self.size))

    def start(self, seeds: list[int]) -> Agent:
        """Return the agents before their first iteration, leaves [S, ...].

        Args:
          seeds: one for each.
        """
        train = self.init(seeds, self.experiment.example)
        score = jnp.zeros((self.size, self.experiment.config.num_envs))
        return Agent(train, self.begin(train), score)

    def train(self, agents: Agent, numbers: dict[str, list[float]]) -> tuple[Agent, Curve]:
        """Train agents side by side for one part, each with its numbers.

        Args:
          agents: before it.
          numbers: by the option's name, a value for each agent.
        """
        given = {name: jnp.asarray(values, jnp.float32) for name, values in numbers.items()}
        agents, curve = self.program(agents, given)
        return agents, Curve(*map(np.asarray, curve))
