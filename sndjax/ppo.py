"""Proximal policy optimization for two reward streams (Schulman et al., 2017)."""

import functools
from typing import Literal, NamedTuple

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sndjax.returns import generalized_advantage
from sndjax.statistics import mask_rows, masked_mean
from sndjax.types import Experience, Metrics

Combine = Literal["streams", "sum", "product"]
NormalizeOver = Literal["rollout", "minibatch"]


class Hyperparameters(NamedTuple):
    """Table 5.2, and what others run PPO with; the defaults of these change nothing.

    With two streams `ext_weight` and `int_weight` add the two advantages; with one, the two
    rewards, see `combine_rewards`.
    """

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
    combine: Combine = "streams"
    ext_exponent: float = 0.75  # xi of combine="product"
    anneal_iterations: int = 0  # the learning rate falls to 0 over so many; 0: it stays
    adam_eps: float = 1e-8
    value_clip: float | None = None  # a value moves no further than this from the old one
    clip_int_value: bool = True  # False: the intrinsic head's moves freely
    normalize_over: NormalizeOver = "rollout"  # where `normalize_advantages`
    target_kl: float | None = None  # no further epoch after one that ends beyond it
    shuffle_each_epoch: bool = False  # False: one permutation for all epochs
    normalize_rewards: bool = False  # external ones, as gymnasium's wrapper does
    normalize_observations: bool = False  # vectors, as gymnasium's wrapper does


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


def normalize_advantage(
    advantage: Float[Array, "*rows"], valid: Bool[Array, "*rows"]
) -> Float[Array, "*rows"]:
    """Return advantages with mean 0 and standard deviation 1 over the valid rows, 0 elsewhere.

    Args:
      advantage: of every row.
      valid: the rows that count.

    >>> normalize_advantage(jnp.array([1.0, 3.0, 9.0]), jnp.array([True, True, False]))
    Array([-1.,  1.,  0.], dtype=float32)
    """
    mean = jnp.mean(advantage, where=valid)
    deviation = jnp.std(advantage, where=valid) + 1e-8
    return jnp.where(valid, (advantage - mean) / deviation, 0.0)


def squared_value_error(
    value: Float[Array, "B K"],
    target: Float[Array, "B K"],
    old_value: Float[Array, "B K"] | None,
    hyper: Hyperparameters,
) -> Float[Array, "B K"]:
    """Compute (V - target)^2, or with `value_clip` the larger of it and its clipped form::

        max((V - target)^2, (V_old + clip(V - V_old, -c, c) - target)^2)

    OpenAI baselines' PPO; it is in no paper.

    Args:
      value: of the critic now.
      target: the return of each stream.
      old_value: of the critic that collected the rollout; needed to clip.
      hyper: the clipping range, and whether the intrinsic head is clipped too.

    >>> value, target, old = jnp.array([[1.0]]), jnp.array([[1.5]]), jnp.array([[0.0]])
    >>> squared_value_error(value, target, old, Hyperparameters(value_clip=0.5))
    Array([[1.]], dtype=float32)
    """
    error = (value - target) ** 2
    if hyper.value_clip is None:
        return error
    assert old_value is not None, "value_clip needs the values of the rollout"
    moved = jnp.clip(value - old_value, -hyper.value_clip, hyper.value_clip)
    larger = jnp.maximum(error, (old_value + moved - target) ** 2)
    return larger if hyper.clip_int_value else error.at[:, 0].set(larger[:, 0])


def loss(
    logits: Float[Array, "B A"],
    value: Float[Array, "B K"],
    action: Int[Array, " B"],
    old_log_prob: Float[Array, " B"],
    advantage: Float[Array, " B"],
    target: Float[Array, "B K"],
    valid: Bool[Array, " B"],
    hyper: Hyperparameters,
    old_value: Float[Array, "B K"] | None = None,
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
      hyper: the weights and the clipping ranges.
      old_value: of the critic then; where `hyper.value_clip`.

    Returns:
      The scalar loss, and its terms with the KL estimate mean(ratio - 1 - ln ratio) and
      the share of rows whose ratio was clipped.
    """
    rows = (logits, value, action, old_log_prob, advantage, target)
    logits, value, action, old_log_prob, advantage, target = (mask_rows(x, valid) for x in rows)
    if old_value is not None:
        old_value = mask_rows(old_value, valid)
    if hyper.normalize_advantages and hyper.normalize_over == "minibatch":
        advantage = normalize_advantage(advantage, valid)
    log_ratio = log_prob(logits, action) - old_log_prob
    ratio = jnp.exp(log_ratio)
    policy = -masked_mean(clipped_surrogate(ratio, advantage, hyper.clip), valid)
    squared = squared_value_error(value, target, old_value, hyper)
    error = jnp.sum(masked_mean(squared, valid))
    mean_entropy = masked_mean(entropy(logits), valid)
    total = policy + hyper.value_weight * error - hyper.entropy_weight * mean_entropy
    return total, {
        "policy_loss": policy,
        "value_loss": error,
        "entropy": mean_entropy,
        "kl": masked_mean(ratio - 1 - log_ratio, valid),
        "ratio_clipped": masked_mean((jnp.abs(ratio - 1) > hyper.clip).astype(ratio.dtype), valid),
    }


def combine_rewards(
    hyper: Hyperparameters, reward: Float[Array, "T N"], int_reward: Float[Array, "T N"]
) -> Float[Array, "T N"]:
    """Compute one reward from the external and the intrinsic one.

    - `sum`: ext_weight * r_ext + int_weight * r_int (thesis, eq. 4.1 and 4.33; what most published
      ICM and E3B code does).
    - `product`: sign(r_ext) |r_ext|^xi max(r_int, 0)^(1 - xi), xi = `ext_exponent` (eq. 4.32, and
      4.30 where r_ext >= 0). It is 0 wherever r_ext is.

    Args:
      hyper: how, and the weights; with `ext_weight=1` a sum is eq. 4.1, and not with its default.
      reward: the external reward.
      int_reward: the intrinsic reward.

    >>> hyper = Hyperparameters(combine="product", ext_exponent=0.5)
    >>> combine_rewards(hyper, jnp.array([[-4.0, 0.0]]), jnp.array([[9.0, 9.0]]))
    Array([[-6.,  0.]], dtype=float32)
    """
    if hyper.combine == "sum":
        return hyper.ext_weight * reward + hyper.int_weight * int_reward
    novelty = jnp.maximum(int_reward, 0) ** (1 - hyper.ext_exponent)
    return jnp.sign(reward) * jnp.abs(reward) ** hyper.ext_exponent * novelty


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

    Raises:
      ValueError: one reward is made of both, and there are two value heads.
    """
    rollout = batch.rollout
    truncated = batch.truncated if hyper.bootstrap_truncated else None
    streams = [
        (batch.reward, hyper.gamma_ext, True),
        (int_reward, hyper.gamma_int, hyper.episodic_int),
    ]
    weights = (hyper.ext_weight, hyper.int_weight)
    heads = batch.value.shape[-1]
    if hyper.combine != "streams":
        if heads != 1:
            raise ValueError(f"combine={hyper.combine!r} needs value_heads=1, not {heads}")
        combined = combine_rewards(hyper, batch.reward, int_reward)
        streams, weights = [(combined, hyper.gamma_ext, True)], (1.0, 1.0)
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
    if hyper.normalize_advantages and hyper.normalize_over == "rollout":
        total = normalize_advantage(total, valid)
    return total, mask_rows(targets, valid)
