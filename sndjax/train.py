"""One training iteration: intrinsic rewards, advantages, PPO epochs, intrinsic-module epoch.

`make_train_step` composes the four; each is a pure function of its own.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, Shaped

from sndjax import ppo
from sndjax.acting import AgentSpec, scale_observations
from sndjax.intrinsic_training import (
    IntrinsicTrainState,
    module_part,
    read_rewards,
    reward_metrics,
)
from sndjax.networks import match_dtype
from sndjax.optimizer_steps import ShardRows, identity
from sndjax.rollout import (
    stack_to_channels,
    zero_reset_rows,
)
from sndjax.scaling import normalize_rewards
from sndjax.side_by_side import run_side_by_side
from sndjax.statistics import (
    init_return_statistics,
    init_running_statistics,
    init_unit_statistics,
    update_running_statistics,
)
from sndjax.types import Experience, Metrics, ReturnStatistics, RunningStatistics, TrainState
from sndjax.updates import PolicyState, update_intrinsic_module, update_policy
from sndjax.vmap_hint import hint_under_vmap


def init_train_state(
    agent: AgentSpec, key: PRNGKeyArray, example: Shaped[Array, "N *frame"]
) -> TrainState:
    """Return the state before the first iteration.

    Args:
      agent: what learns.
      key: of the random draws, these and all that follow.
      example: frames of all N environments, for their shape and dtype.
    """
    key, key_policy, key_module = jax.random.split(key, 3)
    window = jnp.broadcast_to(example[:1], (agent.stack.size, *example[:1].shape))
    policy = agent.network.init(key_policy, stack_to_channels(window))
    intrinsic, intrinsic_state = (
        agent.intrinsic.module.init(key_module, example) if agent.intrinsic else ({}, {})
    )
    policy_optimizer, intrinsic_optimizer = agent.optimizers()
    return TrainState(
        policy=policy,
        policy_optimizer=policy_optimizer.init(policy),
        intrinsic=intrinsic,
        intrinsic_optimizer=intrinsic_optimizer.init(intrinsic),
        intrinsic_state=intrinsic_state,
        reward_scale=init_return_statistics(example.shape[0]),
        observations=init_observation_statistics(agent, example),
        ext_returns=(
            ReturnStatistics(init_unit_statistics(()), jnp.zeros(example.shape[0], jnp.float32))
            if agent.ppo.normalize_rewards
            else None
        ),
        key=key,
        iteration=jnp.zeros((), jnp.int32),
    )


def init_observation_statistics(
    agent: AgentSpec, example: Shaped[Array, "N *frame"]
) -> RunningStatistics:
    """Return the statistics of vector observations before any; empty where nothing reads them.

    Args:
      agent: what learns.
      example: frames of all N environments.

    Raises:
      ValueError: pixels are to be normalised.
    """
    if agent.ppo.normalize_observations:
        if not jnp.issubdtype(example.dtype, jnp.floating):
            raise ValueError(
                f"normalize_observations is for vectors of floats, not {example.dtype}"
            )
        return init_unit_statistics(example.shape[1:])
    return init_running_statistics(example.shape[1:] if any(agent.unbounded) else ())


def compute_intrinsic_rewards(
    agent: AgentSpec, state: TrainState, batch: Experience, key: PRNGKeyArray
) -> tuple[TrainState, Float[Array, "T N"], Metrics]:
    """Compute the rollout's intrinsic rewards, with the weights that collected it.

    Args:
      agent: what learns.
      state: before.
      batch: the rollout.
      key: of the module's draws.

    Returns:
      The state after reading (episodic memory, running statistics), the rewards, their metrics.
    """
    intrinsic, rollout = agent.intrinsic, batch.rollout
    if intrinsic is None:
        none = jnp.zeros(rollout.valid.shape, jnp.float32)
        return state, none, reward_metrics(none, none, none, rollout.valid)
    read = read_rewards(
        intrinsic,
        module_part(state),
        state.reward_scale,
        rollout,
        agent.ppo.gamma_int,
        key,
    )
    state = state._replace(intrinsic_state=read.intrinsic_state, reward_scale=read.reward_scale)
    return state, read.reward, read.metrics


def normalize_external(
    agent: AgentSpec, batch: Experience, state: TrainState
) -> tuple[Experience, TrainState]:
    """Return the rollout with normalised external rewards, and the state with their statistics.

    Args:
      agent: what learns.
      batch: the rollout.
      state: before.
    """
    rollout = batch.rollout
    assert state.ext_returns is not None
    reward, ext_returns = normalize_rewards(
        batch.reward,
        rollout.done & ~batch.truncated,
        rollout.valid,
        state.ext_returns,
        agent.ppo.gamma_ext,
    )
    return batch._replace(reward=reward), state._replace(ext_returns=ext_returns)


class LearningStart(NamedTuple):
    """An iteration's learning before its first optimizer step.

    Attributes:
      state: with the rewards read; weights, key and iteration are those before.
      batch: the rollout as networks and losses get it.
      advantage: of both reward streams together.
      target: of every value head.
      key: of the next iteration.
      key_policy: of the order of the policy's minibatches.
      key_module: of the module's order and draws.
      observations: the statistics of observations, this rollout's included.
      metrics: of the rewards.
      int_reward: the intrinsic rewards.
    """

    state: TrainState
    batch: Experience
    advantage: Float[Array, "T N"]
    target: Float[Array, "T N K"]
    key: PRNGKeyArray
    key_policy: PRNGKeyArray
    key_module: PRNGKeyArray
    observations: RunningStatistics
    metrics: Metrics
    int_reward: Float[Array, "T N"]


def begin_learning(agent: AgentSpec, state: TrainState, batch: Experience) -> LearningStart:
    """Compute everything of an iteration's learning that comes before the optimizer steps.

    Args:
      agent: what learns.
      state: before.
      batch: the rollout.
    """
    batch = zero_reset_rows(match_dtype(batch, state.policy))
    raw, valid = batch.rollout.frames, batch.rollout.valid
    scale = lambda x: scale_observations(agent, x, state.observations)
    batch = batch._replace(
        history=scale(batch.history), rollout=batch.rollout._replace(frames=scale(raw))
    )
    # Acting folds 1 into the state's key; folding 0 keeps these draws apart from those.
    key, key_reward, key_policy, key_module = jax.random.split(jax.random.fold_in(state.key, 0), 4)
    state, int_reward, metrics = compute_intrinsic_rewards(agent, state, batch, key_reward)
    if agent.ppo.normalize_rewards:
        batch, state = normalize_external(agent, batch, state)
    advantage, target = ppo.compute_advantages(agent.ppo, batch, int_reward)
    observations = state.observations
    if any(agent.unbounded) or agent.ppo.normalize_observations:
        observations = update_running_statistics(observations, raw[:-1], valid)
    return LearningStart(
        state=state,
        batch=batch,
        advantage=advantage,
        target=target,
        key=key,
        key_policy=key_policy,
        key_module=key_module,
        observations=observations,
        metrics=metrics,
        int_reward=int_reward,
    )


def finish_learning(
    start: LearningStart, policy: PolicyState, module: IntrinsicTrainState, terms: Metrics
) -> tuple[TrainState, Metrics, Float[Array, "T N"]]:
    """Return the state after an iteration, its metrics and its intrinsic rewards.

    Args:
      start: the learning before the optimizer steps.
      policy: after them.
      module: after them.
      terms: the metrics of both.
    """
    state = start.state._replace(
        **policy._asdict(),
        **module._asdict(),
        observations=start.observations,
        key=start.key,
        iteration=hint_under_vmap(start.state.iteration) + 1,
    )
    return state, start.metrics | terms, start.int_reward


def make_train_step(
    agent: AgentSpec, shard_rows: ShardRows = identity, beside: str | None = None
) -> Callable[[TrainState, Experience], tuple[TrainState, Metrics, Float[Array, "T N"]]]:
    """Make `train_step(state, batch)`: the whole of one iteration's learning, to be jitted.

    The step returns the new state, the iteration's metrics (scalars; losses are means over
    its minibatches) and the intrinsic rewards. It is pure: `jax.vmap` of it trains one
    agent per seed. Both minibatch sizes must divide T * N.

    Args:
      agent: what learns.
      shard_rows: applied to the rows `[B, ...]` of every minibatch; on several devices it says
        which of them computes which rows (`jax.lax.with_sharding_constraint`).
      beside: the name of a mesh axis of two devices, for small networks: the first trains the
        policy while the second trains the module, which do not depend on each other. The step is
        then called under `jax.shard_map` over this axis, with the same arguments on both.

    >>> from sndjax import VECTOR, ActorCritic, Experience, Rollout
    >>> network = ActorCritic(VECTOR, 3, value_heads=1)
    >>> agent = AgentSpec(network, ppo.Hyperparameters(minibatch_size=4))
    >>> state = init_train_state(agent, jax.random.key(0), jnp.zeros((2, 5)))
    >>> no, yes = jnp.zeros((4, 2), bool), jnp.ones((4, 2), bool)
    >>> rollout = Rollout(jnp.zeros((5, 2, 5)), jnp.zeros((4, 2), int), no, no, yes)
    >>> zero = jnp.zeros((4, 2))
    >>> batch = Experience(rollout, jnp.zeros((0, 2, 5)), zero, no, zero, jnp.zeros((5, 2, 1)))
    >>> state, metrics, int_reward = jax.jit(make_train_step(agent))(state, batch)
    >>> f"{metrics['entropy']:.3f}"
    '1.099'
    """

    def train_step(
        state: TrainState, batch: Experience
    ) -> tuple[TrainState, Metrics, Float[Array, "T N"]]:
        start = begin_learning(agent, state, batch)
        estimate = (start.advantage, start.target)
        learn_policy = lambda: update_policy(
            agent, start.state, start.batch, *estimate, start.key_policy, shard_rows
        )
        learn_module = lambda: update_intrinsic_module(
            agent, start.state, start.batch, start.key_module, shard_rows
        )
        (policy, policy_terms), (module, module_terms) = (
            (learn_policy(), learn_module())
            if beside is None
            else run_side_by_side(beside, learn_policy, learn_module)
        )
        return finish_learning(start, policy, module, policy_terms | module_terms)

    return train_step
