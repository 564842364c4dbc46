import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.rollouts import KINDS, rollout
from hypothesis import given, settings
from hypothesis import strategies as st

from sndjax import distillation_error, distillation_loss, gather_transitions, rnd

VECTOR = KINDS[2]


def case(seed, rows=6, width=4):
    rng = np.random.default_rng(seed)
    a, b = (jnp.asarray(rng.normal(size=(rows, width)).astype(np.float32)) for _ in range(2))
    return a, b, jnp.asarray(rng.random(rows) < 0.7)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_distillation_error_and_loss_random_features_equal_equations_in_float64(seed):
    a, b, valid = case(seed)
    squared = (np.asarray(a, np.float64) - np.asarray(b, np.float64)) ** 2
    np.testing.assert_allclose(distillation_error(a, b), squared.mean(1), rtol=1e-5)
    np.testing.assert_allclose(distillation_error(a, b, "half_sum"), squared.sum(1) / 2, rtol=1e-5)
    counted = squared[np.asarray(valid)]
    if counted.size:
        np.testing.assert_allclose(distillation_loss(a, b, valid), counted.mean(), rtol=1e-5)
        total = distillation_loss(a, b, valid, loss_reduction="sum")
        np.testing.assert_allclose(total, counted.sum(), rtol=1e-5)


def test_distillation_loss_gives_no_gradient_to_target():
    a, b, valid = case(0)
    for keep in (1.0, 0.25):
        loss = lambda a, b, keep=keep: distillation_loss(a, b, valid, jax.random.key(0), keep)
        to_learned, to_target = jax.grad(loss, (0, 1))(a, b)
        assert np.any(to_learned)
        assert not np.any(to_target)


def test_distillation_loss_update_proportion_draws_new_quarter_of_entries_each_time():
    rows, width = 200, 50
    zero, one = jnp.zeros((rows, width)), jnp.ones((rows, width))
    valid = jnp.arange(rows) < 150
    loss = lambda a, key: distillation_loss(a, zero, valid, key, 0.25)
    masks = [np.asarray(jax.grad(loss)(one, jax.random.key(k)) != 0) for k in (0, 1)]
    for mask in masks:
        assert not mask[150:].any()
        assert abs(mask[:150].mean() - 0.25) < 0.02
        assert mask[:150].mean(0).min() > 0  # features are drawn, not whole rows
    assert abs((masks[0] & masks[1])[:150].mean() - 1 / 16) < 0.02
    np.testing.assert_allclose(loss(one, jax.random.key(0)), 1)  # a mean over the drawn entries


def test_rnd_reward_updates_running_mean_before_subtracting_it():
    made = rollout(VECTOR, np.random.default_rng(0))
    module = rnd(VECTOR.actions, VECTOR.size)
    params, state = jax.jit(module.init)(jax.random.key(0), made.frames[0])
    reward, state = module.reward(params, state, made, jax.random.key(1))
    seen = np.asarray(made.frames[:-1])[np.asarray(made.valid)]
    np.testing.assert_allclose(state.moments.mean, seen.mean(0), rtol=1e-4, atol=1e-6)

    # The same reward from weights in NumPy: two ELU layers and a linear one.
    def encode(weights, x):
        torso = weights["params"]["Torso_0"]
        for name in ("Dense_0", "Dense_1"):
            x = x @ np.asarray(torso[name]["kernel"], np.float64)
            x = np.where(x > 0, x, np.expm1(x))
        return x @ np.asarray(weights["params"]["Dense_0"]["kernel"], np.float64)

    x = np.asarray(made.frames[:-1], np.float64) - seen.astype(np.float64).mean(0)
    wanted = ((encode(params.signal, x) - encode(state.encoder, x)) ** 2).sum(-1) / 2
    valid = np.asarray(made.valid)
    np.testing.assert_allclose(np.asarray(reward)[valid], wanted[valid], rtol=1e-3)
    assert np.all(np.asarray(reward)[~valid] == 0)


@pytest.mark.parametrize("mode", ["none", "mean", "standardize"])
@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.name)
def test_rnd_each_preprocess_on_each_input_is_finite(mode, kind):
    made = rollout(kind, np.random.default_rng(0))
    module = rnd(kind.actions, kind.size, preprocess=mode)
    params, state = jax.jit(module.init)(jax.random.key(0), made.frames[0])
    reward, state = jax.jit(module.reward)(params, state, made, jax.random.key(1))
    assert np.all(np.isfinite(reward))
    loss, _ = module.loss(
        params, state, gather_transitions(made, jnp.arange(8)), made, jax.random.key(2)
    )
    assert np.isfinite(loss)
    assert (state.moments is None) == (mode == "none")
