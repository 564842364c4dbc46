"""Distillation: the novelty of a state is how badly a learned network copies a target there."""

from typing import Literal, cast

import chex
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray, Shaped

from sndjax.convolution import to_float
from sndjax.networks import Encoder
from sndjax.preprocessing import Preprocess, preprocessor
from sndjax.rollout import map_steps, without_invalid
from sndjax.statistics import expand, no_moments, update_moments
from sndjax.types import Features, IntrinsicModule, Moments, Objective, Params


def distillation_error(
    learned: Float[Array, "B d"],
    target: Float[Array, "B d"],
    reduction: Literal["mean", "half_sum"] = "mean",
) -> Float[Array, " B"]:
    """The novelty of each state: the squared distance of its two feature vectors.

    Mean over d of (learned - target)^2, as the published experiments have eq. 5.1's sum;
    `half_sum`, half its sum over d, is RND's (Burda et al., 2018).

    >>> distillation_error(jnp.array([[2.0, 0.0]]), jnp.zeros((1, 2)))
    Array([2.], dtype=float32)
    """
    chex.assert_equal_shape([learned, target])
    squared = (learned - target) ** 2
    return jnp.mean(squared, axis=-1) if reduction == "mean" else jnp.sum(squared, axis=-1) / 2


def distillation_loss(
    learned: Float[Array, "B d"],
    target: Float[Array, "B d"],
    valid: Bool[Array, " B"],
    key: PRNGKeyArray | None = None,
    keep: float = 1.0,
    reduction: Literal["mean", "sum"] = "mean",
) -> Float[Array, ""]:
    """Squared error of the learned network against a target that no gradient moves.

    Args:
      learned, target: the features of a minibatch.
      valid: the rows that count.
      key: where `keep` < 1, draws the (row, feature) entries that count this time.
      keep: the share of entries that count (RND: a quarter).
      reduction: over the entries that count.

    >>> one = jnp.ones((2, 3))
    >>> distillation_loss(one, 3 * one, jnp.array([True, False]))
    Array(4., dtype=float32)
    """
    chex.assert_equal_shape([learned, target])
    counted = jnp.broadcast_to(expand(valid, learned), learned.shape)
    if keep < 1:
        assert key is not None, "keep < 1 draws entries with a key"
        counted &= jax.random.bernoulli(key, keep, learned.shape)
    squared = (learned - lax.stop_gradient(target)) ** 2
    total = jnp.sum(jnp.where(counted, squared, jnp.zeros_like(squared)))
    if reduction == "sum":
        return total
    return total / jnp.maximum(jnp.sum(counted, dtype=learned.dtype), 1)


def forward(
    network: Encoder, params: Params, frames: Shaped[Array, "B *frame"]
) -> tuple[Float[Array, "B d"], Float[Array, "B I J C"]]:
    """Features and local map of a batch of frames."""
    return cast(tuple[Array, Array], network.apply(params, frames))


def distillation(
    target: Encoder,
    learned: Encoder,
    objective: Objective | None,
    num_actions: int,
    *,
    signal: Literal["mean", "half_sum"] = "mean",
    reduction: Literal["mean", "sum"] = "mean",
    keep: float = 1.0,
    preprocess: Preprocess = "none",
) -> IntrinsicModule:
    """A module that rewards where a learned network does not yet copy a target network.

    The target is shaped by `objective`, or, with None, stays as it was drawn: that is RND.
    The loss is the objective's plus the distillation's, on separate parameters.

    Args:
      target, learned: the two networks.
      objective: what trains the target on pairs (s_t, s_t+1).
      num_actions: for objectives that look at actions.
      signal: how the reward reduces over features, see `distillation_error`.
      reduction, keep: how the loss does, see `distillation_loss`.
      preprocess: what frames go through first; moments take in a rollout before its
        rewards are read.

    Returns:
      The module. Its params hold "learned", and "target" and "objective" where the target
      is trained; its state the frozen target where not, and the input moments.
    """
    moving = preprocess != "none"

    def init(key, example):
        key_target, key_learned, key_objective = jax.random.split(key, 3)
        frame = to_float(example[:1])
        params = {"learned": learned.init(key_learned, frame)}
        target_params = target.init(key_target, frame)
        state = {"moments": no_moments(frame.shape[1:]) if moving else None}
        if objective is None:
            return params, state | {"target": target_params}
        z, local = forward(target, target_params, frame)
        features = Features(z, z, local, local)
        params["target"] = target_params
        params["objective"] = objective.init(key_objective, features, num_actions)
        return params, state

    def target_of(params, state):
        return state["target"] if objective is None else params["target"]

    def reward(params, state, rollout, key):
        frames = rollout.frames[:-1]
        if moving:
            moments: Moments = state["moments"]
            state = state | {"moments": update_moments(moments, frames, rollout.valid, to_float)}
        prepare = preprocessor(preprocess, state["moments"])

        def novelty(frame):
            frame = prepare(frame)
            copied, _ = forward(learned, params["learned"], frame)
            wanted, _ = forward(target, target_of(params, state), frame)
            return distillation_error(copied, wanted, signal)

        value = map_steps(novelty, frames)
        return jnp.where(rollout.valid, value, jnp.zeros_like(value)), state

    def loss(params, state, batch, rollout, key):
        batch = without_invalid(batch)
        prepare = preprocessor(preprocess, state["moments"])
        frame = prepare(batch.frame)
        key_keep, key_objective = jax.random.split(key)

        def encode(frames):
            return forward(target, target_of(params, state), prepare(frames))

        z, local = encode(batch.frame)
        copied, _ = forward(learned, params["learned"], frame)
        total = distillation_loss(copied, z, batch.valid, key_keep, keep, reduction)
        metrics = {"distillation_loss": total}
        if objective is not None:
            z_next, local_next = encode(batch.next_frame)
            features = Features(z, z_next, local, local_next)
            shaping, terms = objective.loss(
                params["objective"], encode, features, batch, rollout, key_objective
            )
            total = total + shaping
            metrics |= {"objective_loss": shaping} | terms
        return total, metrics

    def update(params, state):
        return state

    return IntrinsicModule(init, reward, loss, update)
