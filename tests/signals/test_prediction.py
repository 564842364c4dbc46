import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.rollouts import KINDS, rollout
from hypothesis import given, settings
from hypothesis import strategies as st

from sndjax import gather_transitions, icm, prediction_error, prediction_loss, sp, sp_vic

VECTOR = KINDS[2]


def case(seed, rows=6, width=4):
    rng = np.random.default_rng(seed)
    a, b = (jnp.asarray(rng.normal(size=(rows, width)).astype(np.float32)) for _ in range(2))
    return a, b, jnp.asarray(np.arange(rows) < rng.integers(1, rows + 1))


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_prediction_error_and_loss_random_features_equal_equations_in_float64(seed):
    a, b, valid = case(seed)
    squared = (np.asarray(a, np.float64) - np.asarray(b, np.float64)) ** 2
    np.testing.assert_allclose(prediction_error(a, b), np.tanh(squared.mean(1)), rtol=1e-5)
    np.testing.assert_allclose(prediction_error(a, b, "mean"), squared.mean(1), rtol=1e-5)
    np.testing.assert_allclose(prediction_error(a, b, "half_sum"), squared.sum(1) / 2, rtol=1e-5)
    wanted = squared[np.asarray(valid)].mean()
    np.testing.assert_allclose(prediction_loss(a, b, valid), wanted, rtol=1e-5)


def forward_in_numpy(params, z, action, actions):
    x = np.concatenate([z, np.eye(actions)[action]], axis=-1)
    for i in range(3):
        dense = params["params"][f"Dense_{i}"]
        x = (np.maximum(x, 0) if i else x) @ np.asarray(dense["kernel"], np.float64)
        x = x + np.asarray(dense["bias"], np.float64)
    return x


def encode_in_numpy(params, x):
    torso = params["params"]["Torso_0"]
    for name in ("Dense_0", "Dense_1"):
        x = x @ np.asarray(torso[name]["kernel"], np.float64)
        x = np.where(x > 0, x, np.expm1(x))
    return x @ np.asarray(params["params"]["Dense_0"]["kernel"], np.float64)


def test_sp_vic_reward_is_prediction_error_at_true_next_state():
    """Compare every row, ends of episodes included, with the networks in NumPy."""
    made = rollout(VECTOR, np.random.default_rng(0), steps=12)
    module = sp_vic(VECTOR.actions, VECTOR.size)
    params, state = jax.jit(module.init)(jax.random.key(0), made.frames[0])
    reward, _ = jax.jit(module.reward)(params, state, made, jax.random.key(1))
    z = encode_in_numpy(params.encoder, np.asarray(made.frames, np.float64))
    foreseen = forward_in_numpy(params.signal, z[:-1], np.asarray(made.action), VECTOR.actions)
    wanted = np.tanh(((foreseen - z[1:]) ** 2).mean(-1))
    valid = np.asarray(made.valid)
    assert np.any(np.asarray(made.done) & valid)
    np.testing.assert_allclose(np.asarray(reward)[valid], wanted[valid], rtol=1e-4)


@pytest.mark.parametrize("gradient", ["symmetric", "detached", "asymmetric"])
def test_sp_prediction_loss_each_gradient_setting_equals_finite_differences(gradient):
    """Compare with finite differences of the loss, where the detached parts are constant."""
    made = rollout(VECTOR, np.random.default_rng(0))
    rows, key = gather_transitions(made, jnp.arange(32)), jax.random.key(2)
    module = sp(VECTOR.actions, VECTOR.size, signal_options={"gradient": gradient})
    params, state = jax.jit(module.init)(jax.random.key(0), made.frames[0])
    forward = lambda p: module.loss(p, state, rows, made, key)[1]["prediction_loss"]
    got = jax.jit(jax.grad(forward))(params)
    assert any(np.any(x) for x in jax.tree.leaves(got.signal))
    kernel = lambda p: p.encoder["params"]["Dense_0"]["kernel"]
    now = encode_in_numpy(params.encoder, np.asarray(rows.frame, np.float64))
    then = encode_in_numpy(params.encoder, np.asarray(rows.next_frame, np.float64))

    def loss(shift):
        """Compute the loss after a shift of the encoder's last layer, where a gradient may flow."""
        encoder = jax.tree.map(np.asarray, params.encoder)
        encoder["params"]["Dense_0"]["kernel"] = np.asarray(kernel(params), np.float64) + shift
        z = encode_in_numpy(encoder, np.asarray(rows.frame, np.float64))
        z_next = encode_in_numpy(encoder, np.asarray(rows.next_frame, np.float64))
        z = now if gradient == "asymmetric" else z
        z_next = z_next if gradient == "symmetric" else then
        foreseen = forward_in_numpy(params.signal, z, np.asarray(rows.action), VECTOR.actions)
        return ((foreseen - z_next) ** 2).mean(-1)[np.asarray(rows.valid)].mean()

    direction = np.random.default_rng(1).normal(size=kernel(params).shape)
    slope = (loss(1e-5 * direction) - loss(-1e-5 * direction)) / 2e-5
    np.testing.assert_allclose((np.asarray(kernel(got)) * direction).sum(), slope, rtol=1e-3)
    assert (gradient == "asymmetric") == (slope == 0)


def test_icm_loss_is_weighted_sum_and_detaches_the_forward_target():
    made = rollout(VECTOR, np.random.default_rng(0))
    rows, key = gather_transitions(made, jnp.arange(32)), jax.random.key(2)
    module = icm(VECTOR.actions, VECTOR.size)
    params, state = jax.jit(module.init)(jax.random.key(0), made.frames[0])
    total, terms = jax.jit(module.loss)(params, state, rows, made, key)
    wanted = 0.8 * terms["inverse_dynamics"] + 0.2 * terms["prediction_loss"]
    np.testing.assert_allclose(total, wanted, rtol=1e-6)
    detached = icm(VECTOR.actions, VECTOR.size, signal_options={"gradient": "detached"})
    whole = icm(VECTOR.actions, VECTOR.size, signal_options={"gradient": "symmetric"})
    slope = lambda m: jax.jit(jax.grad(lambda p: m.loss(p, state, rows, made, key)[0]))(params)
    for same, ours, other in zip(
        *(jax.tree.leaves(slope(m).encoder) for m in (detached, module, whole)), strict=True
    ):
        np.testing.assert_array_equal(ours, same)
        assert ours.ndim == 1 or np.any(np.asarray(ours) != np.asarray(other))
