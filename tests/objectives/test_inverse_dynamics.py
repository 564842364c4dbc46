import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers.rollouts import NO_ROLLOUT, no_encode
from hypothesis import given, settings
from hypothesis import strategies as st

from sndjax import Features, Transition, inverse_dynamics, inverse_dynamics_loss


def case(seed, rows=7, actions=4):
    rng = np.random.default_rng(seed)
    logits = jnp.asarray(3 * rng.normal(size=(rows, actions)).astype(np.float32))
    action = jnp.asarray(rng.integers(0, actions, rows).astype(np.int32))
    valid = rng.random(rows) < 0.7
    valid[0] = True
    return logits, action, jnp.asarray(valid)


def in_numpy(logits, action, valid):
    """Compute eq. 5.8 in float64, one row at a time."""
    rows = [
        -np.log(np.exp(row)[a] / np.exp(row).sum())
        for row, a, v in zip(np.asarray(logits, np.float64), action, valid, strict=True)
        if v
    ]
    return np.mean(rows)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_inverse_dynamics_loss_random_logits_equals_float64_and_optax(seed):
    logits, action, valid = case(seed)
    got, metrics = inverse_dynamics_loss(logits, action, valid)
    np.testing.assert_allclose(got, in_numpy(logits, action, valid), rtol=1e-5)
    theirs = optax.softmax_cross_entropy_with_integer_labels(logits, action)
    np.testing.assert_allclose(got, theirs[np.asarray(valid)].mean(), rtol=1e-5)
    right = (np.argmax(logits, -1) == action)[np.asarray(valid)]
    np.testing.assert_allclose(metrics["inverse_accuracy"], right.mean(), rtol=1e-6)


def test_inverse_dynamics_loss_uniform_logits_is_log_num_actions():
    loss, _ = inverse_dynamics_loss(jnp.zeros((5, 18)), jnp.arange(5), jnp.ones(5, bool))
    np.testing.assert_allclose(loss, np.log(18), rtol=1e-6)


@pytest.mark.parametrize(("last", "middle"), [(1.0, 8), (0.5, 4)])
def test_inverse_dynamics_model_reads_both_states_with_widths_of_thesis_table(last, middle):
    rng = np.random.default_rng(0)
    z, z_next = (jnp.asarray(rng.normal(size=(6, 8)).astype(np.float32)) for _ in range(2))
    features = Features(z, z_next, None, None)
    objective = inverse_dynamics(last)
    params = objective.init(jax.random.key(0), features, 3)
    shapes = [params["params"][f"Dense_{i}"]["kernel"].shape for i in range(3)]
    assert shapes == [(16, 8), (8, middle), (middle, 3)]
    x = np.concatenate([z, z_next], 1).astype(np.float64)
    for i in range(3):
        dense = params["params"][f"Dense_{i}"]
        x = (np.maximum(x, 0) if i else x) @ np.asarray(dense["kernel"], np.float64)
        x = x + np.asarray(dense["bias"], np.float64)
    _, action, valid = case(0, rows=6, actions=3)
    batch = Transition(None, action, None, None, valid)
    got, _ = objective.loss(params, no_encode, features, batch, NO_ROLLOUT, jax.random.key(1))
    np.testing.assert_allclose(got, in_numpy(x, action, valid), rtol=1e-4)
    gain = np.linalg.svd(np.asarray(params["params"]["Dense_0"]["kernel"]))[1]
    np.testing.assert_allclose(gain, np.sqrt(2), rtol=1e-5)


def test_inverse_dynamics_init_one_action_raises_value_error():
    z = jnp.zeros((1, 4))
    with pytest.raises(ValueError, match="at least 2 actions"):
        inverse_dynamics().init(jax.random.key(0), Features(z, z, None, None), 1)
