"""An agent, and how it acts: stacked frames -> policy -> action."""

from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from sndjax import ppo
from sndjax.networks import ActorCritic
from sndjax.rollout import Stack, channels, push
from sndjax.scaling import RewardScale
from sndjax.statistics import deviation
from sndjax.types import IntrinsicModule, Moments, Params


class Motivation(NamedTuple):
    """A novelty module and how its signal and its training are used."""

    module: IntrinsicModule
    eta: float = 0.5
    reward_scale: RewardScale = "none"
    learning_rate: float = 1e-4
    minibatch_size: int = 512
    shuffle: bool = False  # False: minibatches are runs of consecutive time steps


class Agent(NamedTuple):
    """Everything about an agent that learning does not change."""

    network: ActorCritic
    ppo: ppo.Hyperparameters
    motivation: Motivation | None = None  # None: plain PPO with one value head
    stack: Stack = Stack()
    unbounded: tuple[bool, ...] = ()  # which components of a vector have no bounds
    random_action: float = 0.0  # the share of actions that the environment gets at random

    def optimizers(self) -> tuple[optax.GradientTransformation, optax.GradientTransformation]:
        """Adam for the policy, with its gradient norm clipped, and for the module."""
        policy = optax.chain(
            optax.clip_by_global_norm(self.ppo.max_grad_norm), optax.adam(self.ppo.learning_rate)
        )
        return policy, optax.adam(self.motivation.learning_rate if self.motivation else 0.0)


class Actor(NamedTuple):
    """The part of a `TrainState` that acting needs."""

    policy: Params
    observations: Moments
    key: PRNGKeyArray


class Decision(NamedTuple):
    """What a policy did at one time step."""

    action: Int[Array, " N"]
    executed: Int[Array, " N"]  # the action, or now and then a random one in its place
    log_prob: Float[Array, " N"]
    value: Float[Array, "N K"]


def scale_vectors(
    frames: Shaped[Array, "*rows D"], moments: Moments, unbounded: tuple[bool, ...]
) -> Shaped[Array, "*rows D"]:
    """Vectors with their unbounded components divided by the running deviation."""
    if not any(unbounded):
        return frames
    scale = jnp.where(np.array(unbounded), deviation(moments), 1.0)
    return frames / scale.reshape((1,) * (frames.ndim - 1) + (-1,))


def forward(
    network: ActorCritic, params: Params, stacked: Shaped[Array, "B *stack"]
) -> tuple[Float[Array, "B A"], Float[Array, "B K"]]:
    """Logits and values of a batch of stacks."""
    return cast(tuple[Array, Array], network.apply(params, stacked))


def act(
    agent: Agent,
    actor: Actor,
    window: Shaped[Array, "S N *frame"],
    frame: Shaped[Array, "N *frame"],
    first: Bool[Array, " N"],
    step: Int[Array, ""],
) -> tuple[Decision, Shaped[Array, "S N *frame"]]:
    """Push the newest frame onto the stack and sample an action from the policy.

    Args:
      agent, actor: whose policy.
      window: the stack before this frame.
      frame: the newest observation of every environment.
      first: where it opens an episode.
      step: the time step within the rollout; with the actor's key it seeds the draw.

    Returns:
      The decision and the stack with this frame.
    """
    window = push(window, frame, first, agent.stack.repeat)
    seen = scale_vectors(window, actor.observations, agent.unbounded)
    logits, value = forward(agent.network, actor.policy, channels(seen))
    key = jax.random.fold_in(jax.random.fold_in(actor.key, 1), step)
    key_action, key_random, key_which = jax.random.split(key, 3)
    action = jax.random.categorical(key_action, logits)
    executed = action
    if agent.random_action > 0:
        instead = jax.random.randint(key_which, action.shape, 0, agent.network.num_actions)
        replaced = jax.random.bernoulli(key_random, agent.random_action, action.shape)
        executed = jnp.where(replaced, instead, action)
    return Decision(action, executed, ppo.log_prob(logits, action), value), window
