"""Rollouts from the loops of others, whose environments reset themselves within the step."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Shaped

from sndjax.types import Rollout


def weave(even: Shaped[Array, "T N *rest"], odd: Shaped[Array, "T N *rest"]) -> Array:
    """Return even_0, odd_0, even_1, odd_1, ... along the time axis: [2T, N, ...].

    >>> weave(jnp.array([[0], [2]]), jnp.array([[1], [3]])).ravel()
    Array([0, 1, 2, 3], dtype=int32)
    """
    return jnp.stack([even, odd], axis=1).reshape(-1, *even.shape[1:])


def from_autoreset(
    obs: Shaped[Array, "T N *frame"],
    next_obs: Shaped[Array, "T N *frame"],
    action: Int[Array, "T N"],
    done: Bool[Array, "T N"],
    first: Bool[Array, " N"] | None = None,
) -> Rollout:
    """Make the rollout of a loop whose environments reset themselves in the step that ends.

    There obs[t + 1] opens a new episode where done[t], and is not the state after obs[t]. The
    rollout has 2T - 1 rows of the frames obs_0, next_0, obs_1, next_1, ...: row 2t is transition
    t, and the rows between them are not valid. The rewards of a module are those of the same
    transitions with a reset row after each end, bit for bit where environments end together (where
    they do not, statistics over environments meet their rows in another order)::

        reward, state = module.reward(params, state, from_autoreset(...), key)
        reward = reward[::2]  # [T, N]

    A batch of T = 1 are transitions by themselves, for example of a replay buffer.

    Args:
      obs: what the policy saw.
      next_obs: the true next observation, of an episode's last step too: the state that it ended
        in, not the first of the next episode.
      action: what the policy did.
      done: the episode ended with this step.
      first: obs[0] opens an episode. None: it does everywhere; signals with a memory of the
        running episode then forget it.

    >>> at, no = jnp.arange(3.0).reshape(3, 1, 1), jnp.zeros((3, 1), bool)
    >>> rollout = from_autoreset(at, at + 1, jnp.zeros((3, 1), int), no.at[1].set(True))
    >>> rollout.frames.ravel()
    Array([0., 1., 1., 2., 2., 3.], dtype=float32)
    >>> rollout.valid.ravel()
    Array([ True, False,  True, False,  True], dtype=bool)
    >>> rollout.first.ravel()
    Array([ True, False, False, False,  True], dtype=bool)
    """
    row = jnp.ones(done.shape, bool)
    opens = row[0] if first is None else first
    spread = lambda x: weave(x, jnp.zeros_like(x))[:-1]
    return Rollout(
        frames=weave(obs, next_obs),
        action=spread(action),
        first=spread(jnp.concatenate([opens[None], done[:-1]])),
        done=spread(done),
        valid=spread(row),
    )


def from_carried_observations(
    obs: Shaped[Array, "T N *frame"],
    last_obs: Shaped[Array, "N *frame"],
    action: Int[Array, "T N"],
    done: Bool[Array, "T N"],
    first: Bool[Array, " N"],
    reset: Bool[Array, " N"] | None,
) -> Rollout:
    """Make the rollout of a loop that keeps only the observations it acted on.

    Args:
      obs: what the policy saw; obs[t + 1] is what the step after obs[t] returned.
      last_obs: what the last step returned.
      action: what the policy did.
      done: the episode ended with this step.
      first: obs[0] opens an episode.
      reset: the first row is a reset, in loops where an environment that ended resets itself in
        its next step. None: it does in the step that ends, whose last observation is lost; that
        row is not valid.
    """
    if reset is None:
        opens, valid = jnp.concatenate([first[None], done[:-1]]), ~done
    else:
        resets = jnp.concatenate([reset[None], done[:-1]])
        opens, valid = jnp.concatenate([first[None], resets[:-1]]), ~resets
    return Rollout(
        frames=jnp.concatenate([obs, last_obs[None]]),
        action=action,
        first=opens,
        done=done & (valid if reset is not None else True),
        valid=valid,
    )


def count_resets_as_next(
    obs: Shaped[Array, "T N *frame"], next_obs: Shaped[Array, "T N *frame"], done: Array
) -> Int[Array, ""]:
    """Count the ends of episodes whose `next_obs` is what the next episode begins with.

    Args:
      obs: what the policy saw.
      next_obs: what should be the true next observation.
      done: the episode ended with this step.
    """
    same = (obs[1:] == next_obs[:-1]).reshape(-1, *done.shape[1:], math.prod(obs.shape[2:]))
    return jnp.sum(done[:-1] & jnp.all(same, axis=-1), dtype=jnp.int32)
