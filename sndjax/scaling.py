"""The scales of rewards: from a novelty signal to the agent's reward, and of external rewards."""

from typing import Literal

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from sndjax.statistics import (
    batch_statistics,
    merge_statistics,
    std,
    update_return_statistics,
)
from sndjax.types import ReturnStatistics, RunningStatistics

RewardScale = Literal["none", "unclipped", "running_std"]


def scale_reward(
    signal: Float[Array, "T N"],
    valid: Bool[Array, "T N"],
    scale: ReturnStatistics,
    mode: RewardScale,
    eta: float | Float[Array, ""],
    discount: float,
) -> tuple[Float[Array, "T N"], Float[Array, "T N"], ReturnStatistics]:
    """Compute the intrinsic reward of a signal.

    - `none` (the thesis): clip(eta * signal, 0, 1).
    - `unclipped`: eta * signal.
    - `running_std` (Burda et al., 2018): eta * signal over the running standard deviation of
      the signal's discounted sum over time, this rollout included; no clip.

    Args:
      signal: the module's novelty, 0 on reset rows.
      valid: False on reset rows.
      scale: the running scale so far; only `running_std` moves it.
      mode: "none", "unclipped" or "running_std", see above.
      eta: the scale.
      discount: of the sum, the intrinsic gamma.

    Returns:
      The reward, 1 where the clip bound and 0 where it did not, and the new scale.

    >>> from sndjax.statistics import init_return_statistics
    >>> signal, valid = jnp.array([[0.5, 4.0]]), jnp.ones((1, 2), bool)
    >>> scale_reward(signal, valid, init_return_statistics(2), "none", 0.5, 0.99)[:2]
    (Array([[0.25, 1.  ]], dtype=float32), Array([[0., 1.]], dtype=float32))
    """
    if mode == "running_std":
        scale = update_return_statistics(scale, signal, valid, discount)
        return eta * signal / std(scale.moments), jnp.zeros_like(signal), scale
    reward = eta * signal
    if mode == "unclipped":
        return reward, jnp.zeros_like(signal), scale
    return jnp.clip(reward, 0.0, 1.0), (reward > 1).astype(reward.dtype), scale


def normalize_rewards(
    reward: Float[Array, "T N"],
    terminated: Bool[Array, "T N"],
    valid: Bool[Array, "T N"],
    scale: ReturnStatistics,
    discount: float,
) -> tuple[Float[Array, "T N"], ReturnStatistics]:
    """Divide external rewards by the deviation of their discounted sum, as gymnasium's wrapper.

    For every step of all environments, `gymnasium.wrappers.vector.NormalizeReward`::

        R_t = discount * R_t-1 * (1 - terminated_t) + r_t
        r_t' = r_t / sqrt(variance of all R so far, this step's included, + 1e-8)

    Reset rows are skipped, as the wrapper skips them.

    Args:
      reward: r_t.
      terminated: the task ended the episode with this row; a step limit does not count.
      valid: False on reset rows.
      scale: the statistics so far, at first `init_unit_statistics(())` and a sum of 0.
      discount: gamma.

    Returns:
      The normalised rewards, and the statistics after them.
    """

    def step(
        carry: tuple[RunningStatistics, Array], row: tuple[Array, Array, Array]
    ) -> tuple[tuple[RunningStatistics, Array], Array]:
        moments, total = carry
        reward, terminated, valid = row
        total = jnp.where(valid, total * discount * (1 - terminated) + reward, total)
        moments = merge_statistics(moments, batch_statistics(total, valid))
        return (moments, total), reward / jnp.sqrt(moments.m2 / moments.samples + 1e-8)

    rows = (reward, terminated.astype(reward.dtype), valid)
    (moments, total), scaled = lax.scan(step, (scale.moments, scale.discounted), rows)
    return scaled, ReturnStatistics(moments, total)
