"""An agent, and how it acts: stacked frames -> policy -> action."""

from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from sndjax import ppo
from sndjax.actor_critic import ActorCritic, Hidden
from sndjax.intrinsic_training import IntrinsicConfig
from sndjax.networks import match_dtype
from sndjax.rollout import FrameStack, push_frame, stack_to_channels
from sndjax.statistics import std
from sndjax.types import Params, RunningStatistics

LARGEST_MEAN = 10.0  # of an unbounded component, after it is scaled
FARTHEST = 10.0  # deviations that a normalised observation is clipped to


class AgentSpec(NamedTuple):
    """Everything about an agent that learning does not change."""

    network: ActorCritic
    ppo: ppo.Hyperparameters
    intrinsic: IntrinsicConfig | None = None  # None: plain PPO with one value head
    stack: FrameStack = FrameStack()
    unbounded: tuple[bool, ...] = ()  # which components of a vector have no bounds
    random_action: float = 0.0  # the share of actions that the environment gets at random

    def optimizers(self) -> tuple[optax.GradientTransformation, optax.GradientTransformation]:
        """Return Adam for the policy, with its gradient norm clipped, and for the module."""
        hyper = self.ppo
        policy = optax.chain(
            optax.clip_by_global_norm(hyper.max_grad_norm),
            optax.adam(hyper.learning_rate, eps=hyper.adam_eps),
        )
        return policy, self.intrinsic.optimizer() if self.intrinsic else optax.adam(0.0)


class Actor(NamedTuple):
    """The part of a `TrainState` that acting needs."""

    policy: Params
    observations: RunningStatistics
    key: PRNGKeyArray


class ActorMemory(NamedTuple):
    """What a policy remembers of an episode: the older frames of its stack, a recurrent state."""

    window: Shaped[Array, "S N *frame"]  # the stack before the newest frame
    hidden: Hidden = None  # of a recurrent policy


class ActOutput(NamedTuple):
    """What a policy did at one time step."""

    action: Int[Array, " N"]
    executed: Int[Array, " N"]  # the action, or now and then a random one in its place
    log_prob: Float[Array, " N"]
    value: Float[Array, "N K"]


def scale_vectors(
    frames: Shaped[Array, "*rows D"], moments: RunningStatistics, unbounded: tuple[bool, ...]
) -> Shaped[Array, "*rows D"]:
    """Divide the unbounded components of vectors by their running standard deviation.

    Where the mean is more than `LARGEST_MEAN` deviations from zero, the divisor is the mean over
    that number: the mean is not subtracted, and a component that hardly varies would be huge.

    Args:
      frames: vectors; pixels are returned as they are.
      moments: the running statistics of vectors.
      unbounded: which components have no bounds.
    """
    if not any(unbounded):
        return frames
    scale = jnp.maximum(std(moments), jnp.abs(moments.mean) / LARGEST_MEAN)
    scale = jnp.where(np.array(unbounded), scale, 1.0)
    return frames / scale.reshape((1,) * (frames.ndim - 1) + (-1,))


def normalize_observations(
    frames: Shaped[Array, "*rows D"], moments: RunningStatistics
) -> Float[Array, "*rows D"]:
    """Compute clip((x - mean) / sqrt(variance + 1e-8), -10, 10) of vectors.

    `gymnasium.wrappers.vector.NormalizeObservation` with the clip that CleanRL puts behind it. The
    wrapper counts an observation before it is normalised; here the statistics are those of the
    rollouts before, so that what acted is what learns.

    Args:
      frames: vectors.
      moments: the running statistics, at first `init_unit_statistics`.
    """
    rows = tuple(range(frames.ndim - moments.mean.ndim))
    mean, m2 = (jnp.expand_dims(x, rows) for x in (moments.mean, moments.m2))
    far = (frames - mean) / jnp.sqrt(m2 / moments.samples + 1e-8)
    return jnp.clip(far, -FARTHEST, FARTHEST)


def scale_observations(
    agent: AgentSpec, frames: Shaped[Array, "*rows_frame"], moments: RunningStatistics
) -> Shaped[Array, "*rows_frame"]:
    """Return frames as an agent's networks get them: vectors scaled, pixels as they are.

    Args:
      agent: what learns.
      frames: observations.
      moments: the running statistics of vectors.
    """
    if agent.ppo.normalize_observations:
        return normalize_observations(frames, moments)
    return scale_vectors(frames, moments, agent.unbounded)


def forward(
    network: ActorCritic, params: Params, stacked: Shaped[Array, "B *stack"]
) -> tuple[Float[Array, "B A"], Float[Array, "B K"]]:
    """Compute logits and values of a batch of stacks.

    Args:
      network: the policy.
      params: its weights.
      stacked: frames of a stack on the last axis.
    """
    return cast(tuple[Array, Array], network.apply(params, match_dtype(stacked, params)))


def unroll(
    network: ActorCritic,
    params: Params,
    stacked: Shaped[Array, "B *stack"],
    hidden: Hidden,
    first: Bool[Array, "T N"],
) -> tuple[Float[Array, "B A"], Float[Array, "B K"], Hidden]:
    """Compute logits, values and the recurrent state of T steps. See `ActorCritic.unroll`.

    Args:
      network: the policy.
      params: its weights.
      stacked: the rows, B = T * N, frames of a stack on the last axis.
      hidden: the recurrent state before the first step.
      first: where an episode opens.
    """
    seen = match_dtype(stacked, params)
    return cast(
        tuple[Array, Array, Hidden],
        network.apply(params, seen, hidden, first, method="unroll"),
    )


def act(
    agent: AgentSpec,
    actor: Actor,
    memory: ActorMemory,
    frame: Shaped[Array, "N *frame"],
    first: Bool[Array, " N"],
    step: Int[Array, ""],
    greedy: bool = False,
) -> tuple[ActOutput, ActorMemory]:
    """Push the newest frame onto the stack and sample an action from the policy.

    Args:
      agent: what acts.
      actor: its weights and its key.
      memory: the stack before this frame, and the recurrent state if the policy has one.
      frame: the newest observation of every environment.
      first: where it opens an episode.
      step: the time step within the rollout; with the actor's key it seeds the draw.
      greedy: take the most probable action instead of sampling one.

    Returns:
      What the policy did, and the memory with this frame.
    """
    window = push_frame(memory.window, frame, first, agent.stack.repeat)
    seen = stack_to_channels(scale_observations(agent, window, actor.observations))
    logits, value, hidden = unroll(agent.network, actor.policy, seen, memory.hidden, first[None])
    key = jax.random.fold_in(jax.random.fold_in(actor.key, 1), step)
    key_action, key_random, key_which = jax.random.split(key, 3)
    action = (
        jnp.argmax(logits, axis=-1) if greedy else jax.random.categorical(key_action, logits)
    ).astype(jnp.int32)
    executed = action
    if agent.random_action > 0:
        instead = jax.random.randint(
            key_which, action.shape, 0, agent.network.num_actions, jnp.int32
        )
        replaced = jax.random.bernoulli(key_random, agent.random_action, action.shape)
        executed = jnp.where(replaced, instead, action)
    output = ActOutput(action, executed, ppo.log_prob(logits, action), value)
    return output, ActorMemory(window, hidden)
