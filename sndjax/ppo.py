"""Proximal policy optimization for two reward streams (Schulman et al., 2017)."""

import functools
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sndjax.returns import generalized_advantage
from sndjax.statistics import mask_rows, masked_mean
from sndjax.types import Experience, Metrics


class Hyperparameters(NamedTuple):
    """Table 5.2. `ext_weight` and `int_weight` add the two advantages."""

    learning_rate: float = 1e-4
    minibatch_size: int = 512
    epochs: int = 4
    clip: float = 0.1
    gamma_ext: float = 0.998
    gamma_int: float = 0.99
    gae_lambda: float = 0.95
    entropy_weight: float = 0.001
    value_weight: float = 0.5
    max_grad_norm: float = 0.5
    ext_weight: float = 2.0
    int_weight: float = 1.0
    normalize_advantages: bool = False
    bootstrap_truncated: bool = False
    episodic_int: bool = True
    published_mask: bool = False  # the published baseline's: done where not-done belongs


def log_prob(logits: Float[Array, "B A"], action: Int[Array, " B"]) -> Float[Array, " B"]:
    """Compute the log-probability of each action under the softmax of its logits."""
    return jnp.take_along_axis(jax.nn.log_softmax(logits), action[:, None], axis=-1)[:, 0]


def entropy(logits: Float[Array, "B A"]) -> Float[Array, " B"]:
    """Compute the entropy in nats of the categorical distribution of each row of logits.

    >>> entropy(jnp.zeros((1, 4))).round(4)
    Array([1.3863], dtype=float32)
    """
    log_p = jax.nn.log_softmax(logits)
    return -jnp.sum(jnp.exp(log_p) * log_p, axis=-1)


def clipped_surrogate(
    ratio: Float[Array, " B"], advantage: Float[Array, " B"], clip: float
) -> Float[Array, " B"]:
    """Compute the objective to maximise: min(r A, clip(r, 1 - e, 1 + e) A), eq. 7 of the paper.

    Args:
      ratio: pi(a | s) / pi_old(a | s), one per row.
      advantage: A, one per row.
      clip: e.

    >>> clipped_surrogate(jnp.array([1.5, 1.5]), jnp.array([1.0, -1.0]), 0.1)
    Array([ 1.1, -1.5], dtype=float32)
    """
    chex.assert_rank([ratio, advantage], 1)
    return jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - clip, 1 + clip) * advantage)


def loss(
    logits: Float[Array, "B A"],
    value: Float[Array, "B K"],
    action: Int[Array, " B"],
    old_log_prob: Float[Array, " B"],
    advantage: Float[Array, " B"],
    target: Float[Array, "B K"],
    valid: Bool[Array, " B"],
    hyper: Hyperparameters,
) -> tuple[Float[Array, ""], Metrics]:
    """Compute the loss of one minibatch, over its valid rows::

        - mean(clipped surrogate) + value_weight * sum_k mean((V_k - target_k)^2)
        - entropy_weight * mean(entropy)

    Args:
      logits: of the policy now.
      value: of the critic now.
      action: what was done.
      old_log_prob: its log-probability when it was done.
      advantage: the weighted sum of both streams' advantages.
      target: the return of each stream, one column per value head.
      valid: False on reset rows.
      hyper: the weights and the clipping range.

    Returns:
      The scalar loss, and its terms with the KL estimate mean(ratio - 1 - ln ratio) and
      the share of rows whose ratio was clipped.
    """
    rows = (logits, value, action, old_log_prob, advantage, target)
    logits, value, action, old_log_prob, advantage, target = (mask_rows(x, valid) for x in rows)
    log_ratio = log_prob(logits, action) - old_log_prob
    ratio = jnp.exp(log_ratio)
    policy = -masked_mean(clipped_surrogate(ratio, advantage, hyper.clip), valid)
    error = jnp.sum(masked_mean((value - target) ** 2, valid))
    mean_entropy = masked_mean(entropy(logits), valid)
    total = policy + hyper.value_weight * error - hyper.entropy_weight * mean_entropy
    return total, {
        "policy_loss": policy,
        "value_loss": error,
        "entropy": mean_entropy,
        "kl": masked_mean(ratio - 1 - log_ratio, valid),
        "ratio_clipped": masked_mean((jnp.abs(ratio - 1) > hyper.clip).astype(ratio.dtype), valid),
    }


def compute_advantages(
    hyper: Hyperparameters, batch: Experience, int_reward: Float[Array, "T N"]
) -> tuple[Float[Array, "T N"], Float[Array, "T N K"]]:
    """Compute the weighted advantage of both reward streams, and the value targets of every head.

    Args:
      hyper: discounts, weights and switches.
      batch: the rollout, its external rewards and values.
      int_reward: the intrinsic rewards.

    Returns:
      The advantage, 0 on reset rows where it is normalised, and the targets, 0 on reset rows.
    """
    rollout = batch.rollout
    truncated = batch.truncated if hyper.bootstrap_truncated else None
    streams = [
        (batch.reward, hyper.gamma_ext, True),
        (int_reward, hyper.gamma_int, hyper.episodic_int),
    ]
    weights = (hyper.ext_weight, hyper.int_weight)
    heads = batch.value.shape[-1]
    # The published mask is the other way round: it cuts within episodes and not between them.
    done = ~rollout.done if hyper.published_mask else rollout.done
    estimates = [
        generalized_advantage(
            reward,
            batch.value[..., k],
            done,
            rollout.valid,
            gamma,
            hyper.gae_lambda,
            truncated,
            episodic,
        )
        for k, (reward, gamma, episodic) in enumerate(streams[:heads])
    ]
    weighted = [w * a for w, a in zip(weights, estimates, strict=False)]
    total = functools.reduce(jnp.add, weighted)
    targets = jnp.stack(estimates, axis=-1) + batch.value[:-1]
    valid = rollout.valid
    if hyper.normalize_advantages:
        mean = jnp.mean(total, where=valid)
        total = jnp.where(valid, (total - mean) / (jnp.std(total, where=valid) + 1e-8), 0.0)
    return total, mask_rows(targets, valid)
