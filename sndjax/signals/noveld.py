"""NovelD: the step from a known state to a novel one, the first time in an episode."""

from typing import Literal, NamedTuple

import chex
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from sndjax.hashing import random_projection, simhash_code
from sndjax.networks import Encoder
from sndjax.protocols import EncoderView, Signal
from sndjax.ranges import HashBits, Share, Weight
from sndjax.signals.distillation import (
    LossReduction,
    RewardReduction,
    distillation,
    rollout_distillation_error,
)
from sndjax.signals.prediction import encode_rollout
from sndjax.statistics import init_running_statistics, update_running_statistics
from sndjax.types import Features, Params, Rollout, RunningStatistics

Novelty = Literal["norm", "squared"]


class EpisodeCentre(NamedTuple):
    """What is subtracted from features before they are hashed."""

    features: RunningStatistics
    mean: Float[Array, "N d"]  # of each environment's episode: the running mean when it opened


class NovelDState(NamedTuple):
    """What NovelD keeps between rollouts."""

    projection: Float[Array, "d k"]  # of the hash
    visited: Bool[Array, "N K"]  # the codes that each environment's episode has seen, K = 2^k
    centre: EpisodeCentre | None  # None where features are hashed as they are


def first_visits(
    visited: Bool[Array, "N K"], code: Int[Array, "T1 N"], rollout: Rollout
) -> tuple[Bool[Array, "T N"], Bool[Array, "N K"]]:
    """Find the rows whose s_t+1 is new to its episode.

    `visited` is forgotten, and s_t marked, where row t opens an episode; s_t+1 of every valid row
    is marked.

    Args:
      visited: the codes that each environment's episode has seen.
      code: of s_0 ... s_T, one of K.
      rollout: where episodes open, and which rows count.

    Returns:
      The rows that are new, and what was visited since.
    """
    chex.assert_rank([visited, code], 2)
    envs = jnp.arange(visited.shape[0])

    def step(
        visited: Bool[Array, "N K"], row: tuple[Array, Array, Array, Array]
    ) -> tuple[Bool[Array, "N K"], Bool[Array, " N"]]:
        now, after, first, valid = row
        first = first & valid
        visited = visited & ~first[:, None]
        visited = visited.at[envs, now].set(visited[envs, now] | first)
        new = valid & ~visited[envs, after]
        return visited.at[envs, after].set(visited[envs, after] | valid), new

    rows = (code[:-1], code[1:], rollout.first, rollout.valid)
    visited, new = lax.scan(step, visited, rows)
    return new, visited


def init_centre(envs: int, width: int) -> EpisodeCentre:
    """Return the centre before any state was seen.

    Args:
      envs: N.
      width: d.
    """
    return EpisodeCentre(
        features=init_running_statistics((width,)), mean=jnp.zeros((envs, width), jnp.float32)
    )


def centre_by_episode(
    z: Float[Array, "T1 N d"], centre: EpisodeCentre, rollout: Rollout
) -> tuple[Float[Array, "T1 N d"], EpisodeCentre]:
    """Subtract the running mean of features, for every episode that of when it opened.

    One mean for the whole of an episode, so that no state of it has two codes, and is new twice.

    Args:
      z: features of s_0 ... s_T.
      centre: before the rollout.
      rollout: where episodes open, and which rows count.

    Returns:
      The centred features, and the centre after the rollout.
    """
    seen = update_running_statistics(centre.features, z[:-1], rollout.valid)
    before = jnp.where(centre.features.samples > 0, centre.mean, seen.mean[None])
    opened = jnp.cumsum(rollout.first & rollout.valid, axis=0, dtype=jnp.int32) > 0
    opened = jnp.concatenate([opened, opened[-1:]])  # s_T belongs to the last row's episode
    mean = jnp.where(opened[..., None], seen.mean[None, None], before[None])
    return z - mean, EpisodeCentre(features=seen, mean=mean[-1])


def noveld_reward(
    novelty: Float[Array, "T1 N"], first_visit: Bool[Array, "T N"], alpha: float = 0.5
) -> Float[Array, "T N"]:
    """Compute max(novelty(s_t+1) - alpha novelty(s_t), 0) where s_t+1 is new to its episode.

    Args:
      novelty: of s_0 ... s_T.
      first_visit: the rows whose s_t+1 is new; others get 0.
      alpha: how much of the novelty of s_t is subtracted.

    >>> noveld_reward(jnp.array([[1.0], [2.0], [0.4]]), jnp.ones((2, 1), bool)).ravel()
    Array([1.5, 0. ], dtype=float32)
    """
    chex.assert_rank([novelty, first_visit], 2)
    gain = jax.nn.relu(novelty[1:] - alpha * novelty[:-1])
    return jnp.where(first_visit, gain, jnp.zeros_like(gain))


def noveld(
    predictor: Encoder,
    *,
    alpha: Weight = 0.5,
    novelty: Novelty = "norm",
    num_hash_bits: HashBits = 14,
    centre: bool = True,
    reward_reduction: RewardReduction = "mean",
    loss_reduction: LossReduction = "mean",
    update_proportion: Share = 1.0,
) -> Signal:
    """Make the gain in distillation novelty from s_t to s_t+1, once per state and episode.

    Zhang et al. (2021), whose novelty is the norm ||predictor - target||. States are distinguished
    within an episode by a SimHash of `num_hash_bits` signs of their features, N * 2^num_hash_bits
    flags in the state.

    Args:
      predictor: of the distillation, see `distillation`.
      alpha: how much of the novelty of s_t is subtracted.
      novelty: "norm" (the paper), or "squared": the distillation error, as the signal
        `distillation` has it. An alpha of 1/2 on squares is one of 0.71 on norms.
      num_hash_bits: k, of the hash.
      centre: subtract the mean of features before they are hashed, see `centre_by_episode`.
      reward_reduction: of the distillation error, where `novelty` is "squared".
      loss_reduction: of the distillation.
      update_proportion: of the distillation.
    """
    reduction: RewardReduction = "norm" if novelty == "norm" else reward_reduction
    base = distillation(
        predictor,
        reward_reduction=reward_reduction,
        loss_reduction=loss_reduction,
        update_proportion=update_proportion,
    )

    def init(
        key: PRNGKeyArray,
        example: Shaped[Array, "N *frame"],
        features: Features,
        num_actions: int,
    ) -> tuple[Params, NovelDState]:
        key_base, key_hash = jax.random.split(key)
        params, _ = base.init(key_base, example, features, num_actions)
        return params, NovelDState(
            projection=random_projection(key_hash, features.z.shape[-1], num_hash_bits),
            visited=jnp.zeros((example.shape[0], 2**num_hash_bits), bool),
            centre=init_centre(example.shape[0], features.z.shape[-1]) if centre else None,
        )

    def reward(
        params: Params,
        state: NovelDState,
        view: EncoderView,
        rollout: Rollout,
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, "T N"], NovelDState]:
        z = encode_rollout(view, rollout.frames)
        error = rollout_distillation_error(predictor, params, view, rollout.frames, z, reduction)
        own = state.centre
        if own is not None:
            z, own = centre_by_episode(z, own, rollout)
        code = simhash_code(z, state.projection)
        new, visited = first_visits(state.visited, code, rollout)
        state = state._replace(visited=visited, centre=own)
        return noveld_reward(error, new, alpha), state

    settings = {
        "alpha": alpha,
        "novelty": novelty,
        "num_hash_bits": num_hash_bits,
        "centre": centre,
    }
    settings |= base.settings
    made = Signal(init, reward, base.loss, name="noveld", settings=settings)
    return made._replace(has_published_scale=False, episodic=True)
