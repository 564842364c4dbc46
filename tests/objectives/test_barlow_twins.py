import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sndjax import barlow_twins_loss as eager_loss

barlow_twins_loss = jax.jit(eager_loss)


def in_numpy(z, z_next, valid, redundancy=5e-3):
    """Compute eq. 3.11 in float64, one pair of features at a time."""
    z, z_next = (np.asarray(v, np.float64)[np.asarray(valid)] for v in (z, z_next))
    width, total = z.shape[1], 0.0
    for i in range(width):
        for j in range(width):
            a, b = z[:, i] - z[:, i].mean(), z_next[:, j] - z_next[:, j].mean()
            c = np.mean(a * b) / np.sqrt((a.var() + 1e-5) * (b.var() + 1e-5))
            total += (1 - c) ** 2 if i == j else redundancy * c**2
    return total


def case(seed, rows=12, width=5):
    rng = np.random.default_rng(seed)
    z, other = (jnp.asarray(rng.normal(size=(rows, width)).astype(np.float32)) for _ in range(2))
    valid = rng.random(rows) < 0.7
    valid[:3] = True
    return z, z + 0.5 * other, jnp.asarray(valid)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_barlow_twins_loss_random_views_equals_equation_in_float64(seed):
    np.testing.assert_allclose(barlow_twins_loss(*case(seed))[0], in_numpy(*case(seed)), rtol=1e-3)


def test_barlow_twins_loss_without_jit_equals_jitted():
    np.testing.assert_allclose(eager_loss(*case(0))[0], barlow_twins_loss(*case(0))[0], rtol=1e-5)


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 2**32 - 1), st.floats(0.5, 1e3), st.floats(-5, 5))
def test_barlow_twins_loss_scaled_shifted_or_reordered_view_is_unchanged(seed, scale, shift):
    z, z_next, valid = case(seed)
    order = np.random.default_rng(seed).permutation(len(z))
    loss = barlow_twins_loss(z, z_next, valid)[0]
    moved = barlow_twins_loss(scale * z[order] + shift * scale, z_next[order], valid[order])[0]
    np.testing.assert_allclose(moved, loss, rtol=1e-3, atol=1e-4)


def test_barlow_twins_loss_equal_uncorrelated_views_is_zero():
    z = np.random.default_rng(0).normal(size=(64, 6))
    z = 8 * np.linalg.svd(z - z.mean(0), full_matrices=False)[0].astype(np.float32)
    loss = barlow_twins_loss(jnp.asarray(z), jnp.asarray(z), jnp.ones(64, bool))[0]
    np.testing.assert_allclose(loss, 0, atol=1e-6)


def test_barlow_twins_loss_collapsed_view_is_one_per_feature_with_small_gradient():
    """Rounding of the mean leaves a tiny variance, which must not be magnified."""
    z, valid = jnp.full((412, 3), 0.1), jnp.ones(412, bool)
    loss, gradient = jax.value_and_grad(lambda z: barlow_twins_loss(z, z, valid)[0])(z)
    np.testing.assert_allclose(loss, 3, rtol=1e-4)
    assert np.abs(gradient).max() < 0.1
    library = np.random.default_rng(0).normal(size=(64, 3))
    np.testing.assert_allclose(in_numpy(library, library, np.ones(64, bool), 0), 0, atol=1e-8)
