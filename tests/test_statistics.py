import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sndjax.statistics import (
    init_return_statistics,
    init_running_statistics,
    masked_mean,
    safe_sqrt,
    std,
    update_return_statistics,
    update_running_statistics,
)


def test_masked_mean_ignores_invalid_rows_in_value_and_gradient():
    x = jnp.array([[1.0, 2.0], [jnp.nan, jnp.inf], [5.0, 6.0]])
    valid = jnp.array([True, False, True])
    np.testing.assert_allclose(masked_mean(x, valid), [3, 4])
    gradient = jax.grad(lambda x: masked_mean(x, valid).sum())(x)
    np.testing.assert_allclose(gradient, [[0.5, 0.5], [0, 0], [0.5, 0.5]])
    np.testing.assert_array_equal(masked_mean(x, jnp.zeros(3, bool)), [0, 0])


def test_safe_sqrt_is_the_square_root_with_gradient_zero_at_zero():
    x = jnp.array([0.0, 1e-30, 4.0])
    np.testing.assert_allclose(safe_sqrt(x), np.sqrt(x))
    gradient = jax.vmap(jax.grad(safe_sqrt))(x)
    assert gradient[0] == 0
    np.testing.assert_allclose(gradient[1:], 0.5 / np.sqrt(x[1:]), rtol=1e-6)


jitted_update = jax.jit(update_running_statistics)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1), st.lists(st.sampled_from([1, 5]), min_size=1, max_size=4))
def test_update_running_statistics_any_split_equals_all_valid_samples(seed, lengths):
    rng = np.random.default_rng(seed)
    moments, seen = init_running_statistics((2,)), []
    for length in lengths:
        x = rng.normal(3, 2, (length, 3, 2)).astype(np.float32)
        valid = rng.random((length, 3)) < 0.7
        seen.append(x[valid])
        x[~valid] = np.nan
        moments = jitted_update(moments, jnp.asarray(x), jnp.asarray(valid))
    seen = np.concatenate(seen).astype(np.float64)
    assert moments.samples == len(seen)
    if len(seen):
        np.testing.assert_allclose(moments.mean, seen.mean(0), atol=1e-5)
        np.testing.assert_allclose(moments.m2 / len(seen), seen.var(0), atol=1e-4)


def test_update_running_statistics_pixels_with_conversion_equals_numpy():
    x = np.random.default_rng(0).integers(0, 256, (5, 4, 6), dtype=np.uint8)
    moments = update_running_statistics(
        init_running_statistics((6,)),
        jnp.asarray(x),
        jnp.ones((5, 4), bool),
        lambda x: x / jnp.float32(255),
    )
    np.testing.assert_allclose(moments.mean, (x / 255).mean((0, 1)), rtol=1e-5)
    np.testing.assert_allclose(std(moments), (x / 255).std((0, 1)), rtol=1e-4)


def test_update_running_statistics_32_million_samples_keeps_precision():
    moments = init_running_statistics(())
    x, valid = jnp.full((64, 256), 0.1), jnp.ones((64, 256), bool)
    x = x.at[:, ::2].set(0.3)
    step = jax.jit(update_running_statistics)
    for _ in range(2000):  # 32 million samples, more than float32 can count one by one
        moments = step(moments, x, valid)
    np.testing.assert_allclose(moments.mean, 0.2, rtol=1e-4)
    np.testing.assert_allclose(std(moments), 0.1, rtol=1e-3)


def test_update_return_statistics_two_rollouts_equals_brute_force():
    rng = np.random.default_rng(0)
    reward = rng.random((2, 7, 3)).astype(np.float32)
    valid = rng.random((2, 7, 3)) < 0.8
    scale, sums, seen = init_return_statistics(3), np.zeros(3), []
    for part in range(2):  # the discounted sum continues from rollout to rollout
        scale = update_return_statistics(
            scale, jnp.asarray(reward[part]), jnp.asarray(valid[part]), 0.9
        )
        for t in range(7):
            for n in range(3):
                if valid[part, t, n]:
                    sums[n] = 0.9 * sums[n] + reward[part, t, n]
                    seen.append(sums[n])
    np.testing.assert_allclose(scale.discounted, sums, rtol=1e-5)
    np.testing.assert_allclose(std(scale.moments), np.std(seen), rtol=1e-5)


@pytest.mark.parametrize("envs", [3, 128, 5000])
def test_std_constant_components_have_none(envs):
    """Only rounding separates the samples of a constant; its deviation counts as 1."""
    constants = np.array([9.81, 0.1, 1e5 + 0.3, 1 / 3, -200.7, 0.0], np.float32)
    moments = init_running_statistics((6,))
    rng = np.random.default_rng(0)
    for _ in range(20):
        x = np.broadcast_to(constants, (8, envs, 6))
        valid = rng.random((8, envs)) < 0.7
        moments = jitted_update(moments, jnp.asarray(x), jnp.asarray(valid))
    np.testing.assert_array_equal(std(moments), 1)
    np.testing.assert_allclose(moments.mean, constants, rtol=3e-7)


def test_std_rounding_of_an_environment_counts_as_none_and_small_spread_does_not():
    """A constant that its environment computes wobbles by a rounding or two."""
    rng = np.random.default_rng(0)
    steps = rng.integers(-2, 3, (50, 64))
    wobbling = np.float32(9.81) + steps * np.spacing(np.float32(9.81))
    spread = 9.81 + 1e-4 * rng.normal(size=(50, 64))  # a hundred roundings
    small = 1e-9 * rng.normal(size=(50, 64))  # around zero there is no rounding to compare with
    x = np.stack([wobbling, spread, small], -1).astype(np.float32)
    moments = jitted_update(init_running_statistics((3,)), jnp.asarray(x), jnp.ones((50, 64), bool))
    wanted = x.astype(np.float64).std((0, 1))
    got = np.asarray(std(moments))
    assert got[0] == 1
    np.testing.assert_allclose(got[1:], wanted[1:], rtol=0.01)
