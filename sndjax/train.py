"""One iteration of learning: `train_step(state, batch)`, composed of pure functions.

A rollout goes through each room once: intrinsic rewards -> advantages of both reward
streams -> PPO epochs -> one pass of the motivation module.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Float, PRNGKeyArray, Shaped

from sndjax import ppo
from sndjax.acting import Agent, forward, scale_vectors
from sndjax.returns import generalized_advantage
from sndjax.rollout import channels, consecutive, stacker, transitions
from sndjax.scaling import scale_reward
from sndjax.statistics import expand, init_return_scale, no_moments, update_moments
from sndjax.types import Experience, Metrics, TrainState

Spread = Callable[[Any], Any]


def alone(rows: Any) -> Any:
    """All rows of a minibatch on one device."""
    return rows


def init(agent: Agent, key: PRNGKeyArray, example: Shaped[Array, "N *frame"]) -> TrainState:
    """The state before the first iteration; `example` gives the shape and dtype of frames."""
    key, key_policy, key_module = jax.random.split(key, 3)
    window = jnp.broadcast_to(example[:1], (agent.stack.size, *example[:1].shape))
    policy = agent.network.init(key_policy, channels(window))
    intrinsic, intrinsic_state = (
        agent.motivation.module.init(key_module, example) if agent.motivation else ({}, {})
    )
    policy_optimizer, intrinsic_optimizer = agent.optimizers()
    return TrainState(
        policy,
        policy_optimizer.init(policy),
        intrinsic,
        intrinsic_optimizer.init(intrinsic),
        intrinsic_state,
        init_return_scale(example.shape[0]),
        no_moments(example.shape[1:] if any(agent.unbounded) else ()),
        key,
        jnp.zeros((), jnp.int32),
    )


def clean(batch: Experience) -> Experience:
    """The batch with what reset rows hold, frames apart, replaced by zeros."""
    rollout = batch.rollout
    valid = rollout.valid
    zero = lambda x: jnp.where(expand(valid, x), x, jnp.zeros_like(x))
    return batch._replace(
        rollout=rollout._replace(
            action=zero(rollout.action), first=rollout.first & valid, done=rollout.done & valid
        ),
        reward=zero(batch.reward),
        truncated=batch.truncated & valid,
        log_prob=zero(batch.log_prob),
    )


def advantages(
    hyper: ppo.Hyperparameters, batch: Experience, int_reward: Float[Array, "T N"]
) -> tuple[Float[Array, "T N"], Float[Array, "T N K"]]:
    """The weighted advantage of both streams, and the value targets of every head."""
    rollout = batch.rollout
    truncated = batch.truncated if hyper.bootstrap_truncated else None
    streams = [
        (batch.reward, hyper.gamma_ext, True),
        (int_reward, hyper.gamma_int, hyper.episodic_int),
    ]
    weights = (hyper.ext_weight, hyper.int_weight)
    heads = batch.value.shape[-1]
    # Their mask is the other way round: it cuts within episodes and not between them.
    done = ~rollout.done if hyper.published_mask else rollout.done
    estimates = [
        generalized_advantage(
            reward,
            batch.value[..., k],
            done,
            rollout.valid,
            gamma,
            hyper.gae_lambda,
            truncated,
            episodic,
        )
        for k, (reward, gamma, episodic) in enumerate(streams[:heads])
    ]
    weighted = [w * a for w, a in zip(weights, estimates, strict=False)]
    total = functools.reduce(jnp.add, weighted)
    targets = jnp.stack(estimates, axis=-1) + batch.value[:-1]
    valid = rollout.valid
    if hyper.normalize_advantages:
        mean = jnp.mean(total, where=valid)
        total = jnp.where(valid, (total - mean) / (jnp.std(total, where=valid) + 1e-8), 0.0)
    return total, jnp.where(expand(valid, targets), targets, 0.0)


def train_policy(
    agent: Agent,
    state: TrainState,
    batch: Experience,
    advantage: Float[Array, "T N"],
    target: Float[Array, "T N K"],
    key: PRNGKeyArray,
    spread: Spread = alone,
) -> tuple[TrainState, Metrics]:
    """The PPO epochs: one permutation of the rollout, gone through `epochs` times."""
    hyper, rollout = agent.ppo, batch.rollout
    stacks = stacker(batch, agent.stack)
    optimizer, _ = agent.optimizers()
    rows = advantage.size
    index = jax.random.permutation(key, rows).reshape(-1, hyper.minibatch_size)
    flat = lambda x: x.reshape(rows, *x.shape[2:])
    columns = [flat(x) for x in (rollout.action, batch.log_prob, advantage, target, rollout.valid)]
    valid = columns[-1]

    def loss(params, stacked, action, log_prob, advantage, target, valid):
        logits, value = forward(agent.network, params, stacked)
        return ppo.loss(logits, value, action, log_prob, advantage, target, valid, hyper)

    def minibatch(carry, index):
        params, optimizer_state = carry
        seen = stacks(index)
        seen = jnp.where(expand(valid[index], seen), seen, jnp.zeros_like(seen))
        rows = spread((seen, *(c[index] for c in columns)))
        (total, metrics), gradient = jax.value_and_grad(loss, has_aux=True)(params, *rows)
        updates, optimizer_state = optimizer.update(gradient, optimizer_state, params)
        metrics |= {"ppo_loss": total, "grad_norm": optax.tree.norm(gradient)}
        return (optax.apply_updates(params, updates), optimizer_state), metrics

    (policy, optimizer_state), metrics = lax.scan(
        minibatch, (state.policy, state.policy_optimizer), jnp.tile(index, (hyper.epochs, 1))
    )
    return state._replace(policy=policy, policy_optimizer=optimizer_state), mean_of(metrics)


def train_module(
    agent: Agent,
    state: TrainState,
    batch: Experience,
    key: PRNGKeyArray,
    spread: Spread = alone,
) -> tuple[TrainState, Metrics]:
    """One pass of the motivation module over the rollout."""
    motivation, rollout = agent.motivation, batch.rollout
    if motivation is None or not jax.tree.leaves(state.intrinsic):
        return state, {}  # nothing is trained
    module = motivation.module
    _, optimizer = agent.optimizers()
    key_order, key_loss = jax.random.split(key)
    rows = jnp.arange(rollout.action.size)
    if motivation.shuffle:
        rows = jax.random.permutation(key_order, rows)
    index = rows.reshape(-1, motivation.minibatch_size)
    # In order, s_t+1 of most rows is s_t of others; in less than a step of rows, of none.
    apart = motivation.shuffle or motivation.minibatch_size < rollout.action.shape[1]

    def minibatch(carry, inputs):
        params, optimizer_state, module_state = carry
        index, key = inputs
        batch = (
            transitions(rollout, index)
            if apart
            else consecutive(rollout, index[0], motivation.minibatch_size)
        )
        (total, metrics), gradient = jax.value_and_grad(module.loss, has_aux=True)(
            params, module_state, spread(batch), rollout, key
        )
        updates, optimizer_state = optimizer.update(gradient, optimizer_state, params)
        params = optax.apply_updates(params, updates)
        metrics |= {"module_loss": total, "module_grad_norm": optax.tree.norm(gradient)}
        return (params, optimizer_state, module.update(params, module_state)), metrics

    start = (state.intrinsic, state.intrinsic_optimizer, state.intrinsic_state)
    keys = jax.random.split(key_loss, index.shape[0])
    (params, optimizer_state, module_state), metrics = lax.scan(minibatch, start, (index, keys))
    state = state._replace(
        intrinsic=params, intrinsic_optimizer=optimizer_state, intrinsic_state=module_state
    )
    return state, mean_of(metrics)


def mean_of(metrics: dict[str, Array]) -> Metrics:
    """The mean over minibatches of every metric."""
    return {name: jnp.mean(value) for name, value in metrics.items()}


def intrinsic_reward(
    agent: Agent, state: TrainState, batch: Experience, key: PRNGKeyArray
) -> tuple[TrainState, Float[Array, "T N"], Metrics]:
    """The rollout's intrinsic rewards, with the weights that collected it."""
    motivation, rollout = agent.motivation, batch.rollout
    valid = rollout.valid
    if motivation is None:
        reward = clipped = signal = jnp.zeros(valid.shape)
    else:
        signal, module_state = motivation.module.reward(
            state.intrinsic, state.intrinsic_state, rollout, key
        )
        reward, clipped, reward_scale = scale_reward(
            signal,
            valid,
            state.reward_scale,
            motivation.reward_scale,
            motivation.eta,
            agent.ppo.gamma_int,
        )
        state = state._replace(intrinsic_state=module_state, reward_scale=reward_scale)
    some = jnp.any(valid)
    mean = lambda x: jnp.where(some, jnp.mean(x, where=valid), 0.0)
    return (
        state,
        reward,
        {
            "int_signal_mean": mean(signal),
            "int_reward_mean": mean(reward),
            "int_reward_std": jnp.where(some, jnp.std(reward, where=valid), 0.0),
            "int_reward_max": jnp.max(reward, where=valid, initial=0.0),
            "int_reward_clipped": mean(clipped),
        },
    )


def make_train_step(
    agent: Agent, spread: Spread = alone
) -> Callable[[TrainState, Experience], tuple[TrainState, Metrics, Float[Array, "T N"]]]:
    """`train_step(state, batch)`: the whole of one iteration's learning, to be jitted.

    The step returns the new state, the iteration's metrics (scalars; losses are means over
    its minibatches) and the intrinsic rewards. It is pure: `jax.vmap` of it trains one
    agent per seed. Both minibatch sizes must divide T * N.

    Args:
      agent: what learns.
      spread: applied to the rows `[B, ...]` of every minibatch; on several devices it says
        which of them computes which rows (`jax.lax.with_sharding_constraint`).

    >>> from sndjax import VECTOR, ActorCritic, Experience, Rollout
    >>> agent = Agent(ActorCritic(VECTOR, 3, value_heads=1), ppo.Hyperparameters(minibatch_size=4))
    >>> state = init(agent, jax.random.key(0), jnp.zeros((2, 5)))
    >>> no, yes = jnp.zeros((4, 2), bool), jnp.ones((4, 2), bool)
    >>> rollout = Rollout(jnp.zeros((5, 2, 5)), jnp.zeros((4, 2), int), no, no, yes)
    >>> zero = jnp.zeros((4, 2))
    >>> batch = Experience(rollout, jnp.zeros((0, 2, 5)), zero, no, zero, jnp.zeros((5, 2, 1)))
    >>> state, metrics, int_reward = jax.jit(make_train_step(agent))(state, batch)
    >>> f"{metrics['entropy']:.3f}"
    '1.099'
    """

    def train_step(state: TrainState, batch: Experience) -> tuple[TrainState, Metrics, Any]:
        batch = clean(batch)
        raw, valid = batch.rollout.frames, batch.rollout.valid
        scale = lambda x: scale_vectors(x, state.observations, agent.unbounded)
        batch = batch._replace(
            history=scale(batch.history), rollout=batch.rollout._replace(frames=scale(raw))
        )
        # Acting folds 1 into the state's key; folding 0 keeps these draws apart from those.
        key, key_reward, key_policy, key_module = jax.random.split(
            jax.random.fold_in(state.key, 0), 4
        )
        state, int_reward, metrics = intrinsic_reward(agent, state, batch, key_reward)
        advantage, target = advantages(agent.ppo, batch, int_reward)
        state, terms = train_policy(agent, state, batch, advantage, target, key_policy, spread)
        metrics |= terms
        state, terms = train_module(agent, state, batch, key_module, spread)
        metrics |= terms
        if any(agent.unbounded):
            moments = update_moments(state.observations, raw[:-1], valid)
            state = state._replace(observations=moments)
        return state._replace(key=key, iteration=state.iteration + 1), metrics, int_reward

    return train_step
