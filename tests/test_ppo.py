import distrax
import jax
import jax.numpy as jnp
import numpy as np
import rlax
from hypothesis import given, settings
from hypothesis import strategies as st

from sndjax import ppo

HYPER = ppo.Hyperparameters()
jitted_loss = jax.jit(ppo.loss, static_argnames="hyper")


def case(seed, rows=16, actions=5):
    rng = np.random.default_rng(seed)
    f = lambda *shape: jnp.asarray(rng.normal(size=shape).astype(np.float32))
    return {
        "logits": f(rows, actions),
        "value": f(rows, 2),
        "action": jnp.asarray(rng.integers(0, actions, rows), jnp.int32),
        "old_log_prob": -jnp.abs(f(rows)) - 1,
        "advantage": f(rows),
        "target": f(rows, 2),
        "valid": jnp.asarray(rng.random(rows) < 0.8),
    }


def in_numpy(c, hyper):
    """Compute the loss in float64 from its equation, row by row."""
    rows = [i for i in range(len(c["action"])) if c["valid"][i]]
    policy = value = entropy = 0.0
    for i in rows:
        logits = np.asarray(c["logits"][i], np.float64)
        p = np.exp(logits) / np.exp(logits).sum()
        ratio = p[c["action"][i]] / np.exp(np.float64(c["old_log_prob"][i]))
        a = np.float64(c["advantage"][i])
        policy += min(ratio * a, min(max(ratio, 1 - hyper.clip), 1 + hyper.clip) * a)
        value += ((np.asarray(c["value"][i], np.float64) - c["target"][i]) ** 2).sum()
        entropy -= (p * np.log(p)).sum()
    n = len(rows)
    return -policy / n + hyper.value_weight * value / n - hyper.entropy_weight * entropy / n


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_ppo_loss_random_batch_equals_equation_in_float64(seed):
    c = case(seed)
    if not c["valid"].any():
        return
    total, _ = jitted_loss(**c, hyper=HYPER)
    np.testing.assert_allclose(total, in_numpy(c, HYPER), rtol=1e-4, atol=1e-5)


def test_clipped_surrogate_random_batch_equals_rlax():
    c = case(0)
    ratio = jnp.exp(ppo.log_prob(c["logits"], c["action"]) - c["old_log_prob"])
    ours = -jnp.mean(ppo.clipped_surrogate(ratio, c["advantage"], 0.1))
    theirs = rlax.clipped_surrogate_pg_loss(ratio, c["advantage"], 0.1)
    np.testing.assert_allclose(ours, theirs, rtol=1e-6)


def test_log_prob_and_entropy_equal_distrax():
    c = case(1)
    categorical = distrax.Categorical(logits=c["logits"])
    np.testing.assert_allclose(
        ppo.log_prob(c["logits"], c["action"]), categorical.log_prob(c["action"]), rtol=1e-5
    )
    np.testing.assert_allclose(ppo.entropy(c["logits"]), categorical.entropy(), rtol=1e-5)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1), st.floats(0.1, 10))
def test_clipped_surrogate_at_ratio_one_has_gradient_of_the_policy_gradient(seed, scale):
    c = case(seed)
    advantage = scale * c["advantage"]
    old = ppo.log_prob(c["logits"], c["action"])

    def surrogate(logits):
        ratio = jnp.exp(ppo.log_prob(logits, c["action"]) - old)
        return jnp.mean(ppo.clipped_surrogate(ratio, advantage, 0.1))

    def policy_gradient(logits):
        return jnp.mean(ppo.log_prob(logits, c["action"]) * advantage)

    np.testing.assert_allclose(
        jax.grad(surrogate)(c["logits"]), jax.grad(policy_gradient)(c["logits"]), atol=1e-5
    )


def test_ppo_loss_reordered_or_without_invalid_rows_is_unchanged():
    c = case(2)
    total, metrics = ppo.loss(**c, hyper=HYPER)
    order = np.random.default_rng(0).permutation(len(c["action"]))
    shuffled, _ = ppo.loss(**{k: v[order] for k, v in c.items()}, hyper=HYPER)
    np.testing.assert_allclose(total, shuffled, rtol=1e-5)
    keep = np.asarray(c["valid"])
    alone, alone_metrics = ppo.loss(**{k: v[keep] for k, v in c.items()}, hyper=HYPER)
    np.testing.assert_allclose(total, alone, rtol=1e-5)
    for name, value in metrics.items():
        np.testing.assert_allclose(value, alone_metrics[name], rtol=1e-4, atol=1e-6)


def test_ppo_loss_kl_is_zero_for_same_policy_and_positive_for_another():
    c = case(3)
    assert ppo.loss(**c, hyper=HYPER)[1]["kl"] > 0
    c["old_log_prob"] = ppo.log_prob(c["logits"], c["action"])
    metrics = ppo.loss(**c, hyper=HYPER)[1]
    assert metrics["kl"] == 0
    assert metrics["ratio_clipped"] == 0
