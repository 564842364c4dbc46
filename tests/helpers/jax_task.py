"""An environment in JAX as a file that a command line names: env.id=.../jax_task.py:make."""

import jax
import jax.numpy as jnp

import sndjax


def make(cells=6, limit=20, wrong_at=0):
    """Return a corridor with random starts; with `wrong_at`, NaN as reward at that time.

    Args:
      cells: its length.
      limit: the longest episode.
      wrong_at: the time of a reward that is not finite, or 0.
    """

    def look(at, time):
        return jax.nn.one_hot(at, cells) + 0.01 * time

    def reset(key):
        at = jax.random.randint(key, (), 0, cells - 2)
        return {"at": at, "time": jnp.int32(0), "key": key}, look(at, 0)

    def step(key, state, action):
        slip = jax.random.bernoulli(key, 0.1)
        at = jnp.clip(state["at"] + jnp.where(slip, 0, 2 * action - 1), 0, cells - 1)
        time = state["time"] + 1
        end = at == cells - 1
        reward = jnp.where(end, 1.0, -0.01)
        reward = jnp.where((time == wrong_at) & (wrong_at > 0), jnp.nan, reward)
        return state | {"at": at, "time": time}, look(at, time), reward, end, time >= limit

    return sndjax.JaxEnvironment(
        reset,
        step,
        num_actions=2,
        low=0.0,
        high=2.0,
        place=lambda state: state["at"],
        num_places=cells,
        progress=lambda state: state["at"].astype(jnp.float32),
    )
