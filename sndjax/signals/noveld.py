"""NovelD: the step from a known state to a novel one, the first time in an episode."""

from typing import Literal

import chex
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from sndjax.hashing import random_projection, simhash_code
from sndjax.networks import Encoder
from sndjax.signals.distillation import distillation, novelty_of_all
from sndjax.signals.prediction import features_of_all
from sndjax.types import Rollout, Signal


def first_visits(
    visited: Bool[Array, "N K"], code: Int[Array, "T1 N"], rollout: Rollout
) -> tuple[Bool[Array, "T N"], Bool[Array, "N K"]]:
    """Whether s_t+1 is new to its episode, its code being one of K; and what was visited since.

    `visited` is forgotten, and s_t marked, where row t opens an episode; s_t+1 of every valid
    row is marked.
    """
    chex.assert_rank([visited, code], 2)
    envs = jnp.arange(visited.shape[0])

    def step(visited, row):
        now, then, first, valid = row
        first = first & valid
        visited = visited & ~first[:, None]
        visited = visited.at[envs, now].set(visited[envs, now] | first)
        new = valid & ~visited[envs, then]
        return visited.at[envs, then].set(visited[envs, then] | valid), new

    rows = (code[:-1], code[1:], rollout.first, rollout.valid)
    visited, new = lax.scan(step, visited, rows)
    return new, visited


def noveld_reward(
    novelty: Float[Array, "T1 N"], first_visit: Bool[Array, "T N"], alpha: float = 0.5
) -> Float[Array, "T N"]:
    """max(novelty(s_t+1) - alpha novelty(s_t), 0), where s_t+1 is new to its episode, else 0.

    >>> noveld_reward(jnp.array([[1.0], [2.0], [0.4]]), jnp.ones((2, 1), bool)).ravel()
    Array([1.5, 0. ], dtype=float32)
    """
    chex.assert_rank([novelty, first_visit], 2)
    gain = jax.nn.relu(novelty[1:] - alpha * novelty[:-1])
    return jnp.where(first_visit, gain, jnp.zeros_like(gain))


def noveld(
    learned: Encoder,
    *,
    alpha: float = 0.5,
    bits: int = 14,
    reading: Literal["mean", "half_sum"] = "mean",
    reduction: Literal["mean", "sum"] = "mean",
    keep: float = 1.0,
) -> Signal:
    """The gain in distillation novelty from s_t to s_t+1, once per state and episode.

    Zhang et al. (2021), whose novelty is RND's. States are told apart within an episode by a
    SimHash of `bits` signs of their features, N * 2^bits flags in the state.

    Args:
      learned, reading, reduction, keep: of the distillation, see there.
      alpha: how much of the novelty of s_t is taken off.
      bits: k, of the hash.
    """
    base = distillation(learned, reading=reading, reduction=reduction, keep=keep)

    def init(key, example, features, num_actions):
        key_base, key_hash = jax.random.split(key)
        params, _ = base.init(key_base, example, features, num_actions)
        return params, {
            "projection": random_projection(key_hash, features.z.shape[-1], bits),
            "visited": jnp.zeros((example.shape[0], 2**bits), bool),
        }

    def reward(params, state, view, rollout, key):
        z = features_of_all(view, rollout.frames)
        code = simhash_code(z, state["projection"])
        new, visited = first_visits(state["visited"], code, rollout)
        novelty = novelty_of_all(learned, params, view, rollout.frames, z, reading)
        return noveld_reward(novelty, new, alpha), state | {"visited": visited}

    return Signal(init, reward, base.loss)
