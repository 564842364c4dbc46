"""An agent, and how it acts: stacked frames -> policy -> action."""

from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from sndjax import ppo
from sndjax.intrinsic_training import IntrinsicConfig
from sndjax.networks import ActorCritic, match_dtype
from sndjax.rollout import FrameStack, push_frame, stack_to_channels
from sndjax.statistics import std
from sndjax.types import Params, RunningStatistics

LARGEST_MEAN = 10.0  # of an unbounded component, after it is scaled


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
        policy = optax.chain(
            optax.clip_by_global_norm(self.ppo.max_grad_norm), optax.adam(self.ppo.learning_rate)
        )
        return policy, self.intrinsic.optimizer() if self.intrinsic else optax.adam(0.0)


class Actor(NamedTuple):
    """The part of a `TrainState` that acting needs."""

    policy: Params
    observations: RunningStatistics
    key: PRNGKeyArray


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


def act(
    agent: AgentSpec,
    actor: Actor,
    window: Shaped[Array, "S N *frame"],
    frame: Shaped[Array, "N *frame"],
    first: Bool[Array, " N"],
    step: Int[Array, ""],
) -> tuple[ActOutput, Shaped[Array, "S N *frame"]]:
    """Push the newest frame onto the stack and sample an action from the policy.

    Args:
      agent: what acts.
      actor: its weights and its key.
      window: the stack before this frame.
      frame: the newest observation of every environment.
      first: where it opens an episode.
      step: the time step within the rollout; with the actor's key it seeds the draw.

    Returns:
      What the policy did, and the stack with this frame.
    """
    window = push_frame(window, frame, first, agent.stack.repeat)
    seen = scale_vectors(window, actor.observations, agent.unbounded)
    logits, value = forward(agent.network, actor.policy, stack_to_channels(seen))
    key = jax.random.fold_in(jax.random.fold_in(actor.key, 1), step)
    key_action, key_random, key_which = jax.random.split(key, 3)
    action = jax.random.categorical(key_action, logits).astype(jnp.int32)
    executed = action
    if agent.random_action > 0:
        instead = jax.random.randint(
            key_which, action.shape, 0, agent.network.num_actions, jnp.int32
        )
        replaced = jax.random.bernoulli(key_random, agent.random_action, action.shape)
        executed = jnp.where(replaced, instead, action)
    return ActOutput(action, executed, ppo.log_prob(logits, action), value), window
