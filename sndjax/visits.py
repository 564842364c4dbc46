"""What environments in JAX have seen of their world: the places that were visited, how far."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sndjax.jax_environment import JaxEnvironment


class Visits(NamedTuple):
    """What N environments have seen of their world so far, all episodes together."""

    visited: Bool[Array, " P"]  # the places that a state was in
    progress: Float[Array, ""]  # the sum of the episodes' progress at their ends
    episodes: Int[Array, ""]  # that ended


def init_visits(env: JaxEnvironment, state: Any) -> Visits | None:
    """Return the visits of N environments after their first resets; None without `place`.

    Args:
      env: the environment.
      state: of each, leaves [N, ...].
    """
    if env.place is None:
        return None
    visited = jnp.zeros(env.num_places, bool).at[jax.vmap(env.place)(state)].set(True)
    return Visits(visited, jnp.zeros((), jnp.float32), jnp.zeros((), jnp.int32))


def update_visits(
    env: JaxEnvironment, visits: Visits | None, state: Any, done: Bool[Array, " N"]
) -> Visits | None:
    """Return the visits with the states after a step.

    Args:
      env: the environment.
      visits: before.
      state: of each environment after the step, leaves [N, ...].
      done: which episodes ended with it.
    """
    if visits is None or env.place is None:
        return None
    progress = jax.vmap(env.progress)(state) if env.progress else jnp.zeros(done.shape)
    return Visits(
        visited=visits.visited.at[jax.vmap(env.place)(state)].set(True),
        progress=visits.progress + jnp.where(done, progress, 0).sum().astype(jnp.float32),
        episodes=visits.episodes + done.sum(dtype=jnp.int32),
    )
