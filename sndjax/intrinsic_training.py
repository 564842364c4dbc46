"""An intrinsic module in a training loop: its rewards, and its optimizer steps."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sndjax.intrinsic_module import IntrinsicModule
from sndjax.optimizer_steps import (
    ShardRows,
    identity,
    mean_metrics,
    optimizer_step,
    step_with_rows,
)
from sndjax.passes import Pass, run_pass
from sndjax.rollout import gather_rows, slice_transitions
from sndjax.scaling import RewardScale, scale_reward
from sndjax.types import Metrics, Params, ReturnStatistics, Rollout, State, TrainState


class IntrinsicConfig(NamedTuple):
    """An intrinsic module, and how its signal and its training are used."""

    module: IntrinsicModule
    eta: float = 0.5
    reward_scale: RewardScale = "none"
    learning_rate: float = 1e-4
    minibatch_size: int = 512
    shuffle: bool = False  # False: minibatches are runs of consecutive time steps
    epochs: int = 1  # passes over a rollout
    anneal_iterations: int = 0  # the learning rate falls to 0 over so many; 0: it stays
    adam_eps: float = 1e-8
    max_grad_norm: float | None = None  # larger gradients are scaled down; None: they are not

    def optimizer(self) -> optax.GradientTransformation:
        """Return Adam for the module."""
        adam = optax.adam(self.learning_rate, eps=self.adam_eps)
        if self.max_grad_norm is None:
            return adam
        return optax.chain(optax.clip_by_global_norm(self.max_grad_norm), adam)


class IntrinsicTrainState(NamedTuple):
    """The part of a `TrainState` that training the module changes; named as there."""

    intrinsic: Params
    intrinsic_optimizer: optax.OptState
    intrinsic_state: State


def module_part(state: TrainState) -> IntrinsicTrainState:
    """Return the part of a state that training the module changes."""
    return IntrinsicTrainState(state.intrinsic, state.intrinsic_optimizer, state.intrinsic_state)


class IntrinsicRewards(NamedTuple):
    """The rewards of a rollout, and what reading them changed."""

    reward: Float[Array, "T N"]
    intrinsic_state: State
    reward_scale: ReturnStatistics
    metrics: Metrics


def read_rewards(
    intrinsic: IntrinsicConfig,
    trained: IntrinsicTrainState,
    reward_scale: ReturnStatistics,
    rollout: Rollout,
    discount: float,
    key: PRNGKeyArray,
) -> IntrinsicRewards:
    """Read the signal of a rollout and scale it, see `scale_reward`.

    Args:
      intrinsic: the module, and how its signal is scaled.
      trained: the module's parameters and state.
      reward_scale: the running scale before.
      rollout: what to read.
      discount: the intrinsic gamma.
      key: of the module's draws.
    """
    signal, intrinsic_state = intrinsic.module.reward(
        trained.intrinsic, trained.intrinsic_state, rollout, key
    )
    reward, clipped, reward_scale = scale_reward(
        signal, rollout.valid, reward_scale, intrinsic.reward_scale, intrinsic.eta, discount
    )
    metrics = reward_metrics(signal, reward, clipped, rollout.valid)
    return IntrinsicRewards(reward, intrinsic_state, reward_scale, metrics)


def reward_metrics(
    signal: Float[Array, "*rows"],
    reward: Float[Array, "*rows"],
    clipped: Float[Array, "*rows"],
    valid: Bool[Array, "*rows"],
) -> Metrics:
    """Return means, deviation and maximum over the valid rows, 0 where there are none.

    Args:
      signal: unscaled.
      reward: scaled.
      clipped: 1 where the clip bound.
      valid: the rows that count.
    """
    some = jnp.any(valid)
    mean = lambda x: jnp.where(some, jnp.mean(x, where=valid), 0.0)
    return {
        "int_signal_mean": mean(signal),
        "int_reward_mean": mean(reward),
        "int_reward_std": jnp.where(some, jnp.std(reward, where=valid), 0.0),
        "int_reward_max": jnp.max(reward, where=valid, initial=0.0),
        "int_reward_clipped": mean(clipped),
    }


def module_pass(
    intrinsic: IntrinsicConfig,
    start: IntrinsicTrainState,
    rollout: Rollout,
    index: Int[Array, "M B"],
    key: PRNGKeyArray,
    apart: bool = True,
    shard_rows: ShardRows = identity,
    rate: Float[Array, ""] | None = None,
) -> Pass:
    """Return the optimizer steps of an intrinsic module on M minibatches.

    Args:
      intrinsic: the module, and how it is trained.
      start: the module before.
      rollout: what it is trained on.
      index: rows of the flattened rollout; a row that does not exist does not count.
      key: of the module's draws.
      apart: False: the rows of a minibatch follow each other, and share their frames.
      shard_rows: see `make_train_step`.
      rate: a factor of the learning rate; None: 1.
    """
    module, optimizer = intrinsic.module, intrinsic.optimizer()

    def minibatch(
        carry: IntrinsicTrainState, inputs: tuple[Array, PRNGKeyArray]
    ) -> tuple[IntrinsicTrainState, Metrics]:
        params, _, module_state = carry
        index, key = inputs
        batch = (
            gather_rows(rollout, index)
            if apart
            else slice_transitions(rollout, index[0], index.shape[0])
        )
        (total, metrics), gradient = jax.value_and_grad(module.loss, has_aux=True)(
            params, module_state, shard_rows(batch), rollout, key
        )
        metrics |= {"module_loss": total, "module_grad_norm": optax.tree.norm(gradient)}

        def step(carry: IntrinsicTrainState) -> IntrinsicTrainState:
            params, optimizer_state, module_state = carry
            trained = (params, optimizer_state)
            params, optimizer_state = optimizer_step(optimizer, gradient, rate, trained)
            return IntrinsicTrainState(params, optimizer_state, module.update(params, module_state))

        return step_with_rows(step, carry, batch.valid), metrics

    return Pass(minibatch, start, (index, jax.random.split(key, index.shape[0])))


def train_module(
    intrinsic: IntrinsicConfig,
    start: IntrinsicTrainState,
    rollout: Rollout,
    index: Int[Array, "M B"],
    key: PRNGKeyArray,
) -> tuple[IntrinsicTrainState, Metrics]:
    """Take one optimizer step of an intrinsic module on each of M minibatches.

    Args:
      intrinsic: the module, and how it is trained.
      start: the module before.
      rollout: what it is trained on.
      index: rows of the flattened rollout; a row that does not exist does not count.
      key: of the module's draws.

    Returns:
      The module after, and the means of its metrics over minibatches.
    """
    if not jax.tree.leaves(start.intrinsic):
        return start, {}  # nothing is trained
    learned, metrics = run_pass(module_pass(intrinsic, start, rollout, index, key))
    return learned, mean_metrics(metrics)
