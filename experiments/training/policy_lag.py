"""The policy that collects the next rollout: the newest one, or with overlap=1 the one before."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

import sndjax

LAG_STREAM = 4  # folded into a seed's key: a policy that acts twice draws other numbers


class NextActor(NamedTuple):
    """The policy that collects the next rollout, and the number of iterations it has learned."""

    actor: sndjax.Actor
    iteration: Any


def actor_of(train: sndjax.TrainState) -> sndjax.Actor:
    """Return the part of a state that acts."""
    return sndjax.Actor(train.policy, train.observations, train.key)


def first_actor(train: sndjax.TrainState) -> NextActor:
    """Return a copy of the policy before any learning, which collects the first rollout."""
    return NextActor(*jax.tree.map(jnp.copy, (actor_of(train), train.iteration)))


def lagging_actor(train: sndjax.TrainState) -> NextActor:
    """Return a copy of the policy of a state, for the rollout collected while that state learns.

    Args:
      train: the state of one seed before an iteration's learning.
    """
    actor = actor_of(train)._replace(key=jax.random.fold_in(train.key, LAG_STREAM))
    return NextActor(*jax.tree.map(jnp.copy, (actor, train.iteration)))


def policy_lag(train: sndjax.TrainState, behind: NextActor) -> Any:
    """Return how many iterations a rollout's policy is behind the state that learns from it.

    Args:
      train: the state before learning.
      behind: what collected the rollout.
    """
    return (train.iteration - behind.iteration).astype(jnp.float32)
