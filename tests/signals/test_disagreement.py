import jax
import jax.numpy as jnp
import numpy as np
from helpers.rollouts import KINDS, rollout
from hypothesis import given, settings
from hypothesis import strategies as st

from sndjax import ensemble_variance, gather_transitions, make_module
from sndjax.grid import OBJECTIVES, make_encoder_and_predictor
from sndjax.signals.prediction import predict_next_features

VECTOR = KINDS[2]


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(2, 6))
def test_ensemble_variance_random_members_equals_variance_in_float64(seed, members):
    predicted = np.random.default_rng(seed).normal(size=(members, 5, 4)).astype(np.float32)
    exact = predicted.astype(np.float64)
    wanted = ((exact - exact.mean(0, keepdims=True)) ** 2).mean(0).mean(-1)
    np.testing.assert_allclose(ensemble_variance(jnp.asarray(predicted)), wanted, rtol=1e-4)
    order = np.random.default_rng(seed).permutation(members)
    np.testing.assert_allclose(ensemble_variance(jnp.asarray(predicted[order])), wanted, rtol=1e-4)


def test_ensemble_variance_equal_members_is_zero():
    np.testing.assert_array_equal(ensemble_variance(jnp.ones((5, 3, 2))), 0)


def test_disagreement_members_start_different_and_reward_is_their_variance():
    made = rollout(VECTOR, np.random.default_rng(0))
    module = make_module("none", "disagreement", VECTOR.actions, VECTOR.size)
    params, state = jax.jit(module.init)(jax.random.key(0), made.frames[0])
    reward, _ = jax.jit(module.reward)(params, state, made, jax.random.key(1))
    encoder, _ = make_encoder_and_predictor(OBJECTIVES["none"], VECTOR.size, "elu", "asymmetric")
    rows = gather_transitions(made, jnp.arange(32))
    z, _ = encoder.apply(state.encoder, rows.frame)
    predictions = [
        predict_next_features(jax.tree.map(lambda x, k=k: x[k], params.signal), z, rows.action)
        for k in range(5)
    ]
    assert np.abs(predictions[0] - predictions[1]).max() > 0.1
    wanted = np.var(np.asarray(predictions, np.float64), axis=0).mean(-1)
    valid = np.asarray(rows.valid)
    np.testing.assert_allclose(np.asarray(reward).ravel()[valid], wanted[valid], rtol=1e-4)


def test_disagreement_loss_each_member_learns_from_different_rows():
    """The gradients of members with equal weights differ, because they use different rows."""
    made = rollout(VECTOR, np.random.default_rng(0))
    module = make_module("none", "disagreement", VECTOR.actions, VECTOR.size)
    params, state = jax.jit(module.init)(jax.random.key(0), made.frames[0])
    equal = jax.tree.map(lambda x: jnp.stack([x[0]] * 5), params.signal)
    params = params._replace(signal=equal)
    rows = gather_transitions(made, jnp.arange(32))
    gradient = jax.jit(jax.grad(lambda p, k: module.loss(p, state, rows, made, k)[0]))
    kernel = gradient(params, jax.random.key(0)).signal["params"]["Dense_2"]["kernel"]
    assert all(np.abs(kernel[0] - kernel[k]).max() > 0 for k in range(1, 5))
