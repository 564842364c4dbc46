import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sndjax import vicreg_loss as eager_vicreg_loss

vicreg_loss = jax.jit(eager_vicreg_loss)


def in_numpy(z, z_next, valid):
    """Compute eq. 5.7 with the sums of eq. 3.12-3.14 written out, in float64."""
    views = [np.asarray(v, np.float64)[np.asarray(valid)] for v in (z, z_next)]
    n, d = views[0].shape
    total = sum(((views[0][i] - views[1][i]) ** 2).sum() for i in range(n)) / (n * d)
    for view in views:
        covariance = np.cov(view, rowvar=False)
        for j in range(d):
            total += max(0, 1 - np.sqrt(view[:, j].var(ddof=1) + 1e-4)) / d
            for i in range(d):
                total += (covariance[i, j] ** 2 / d / 25) if i != j else 0
    return total


def case(seed, rows=12, width=5):
    rng = np.random.default_rng(seed)
    z, z_next = (
        jnp.asarray(0.5 * rng.normal(size=(rows, width)).astype(np.float32)) for _ in range(2)
    )
    valid = rng.random(rows) < 0.7
    valid[:2] = True
    return z, z_next, jnp.asarray(valid)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_vicreg_loss_random_views_equals_equation_in_float64(seed):
    case_ = case(seed)
    np.testing.assert_allclose(vicreg_loss(*case_)[0], in_numpy(*case_), rtol=1e-4)


def test_vicreg_loss_without_jit_equals_jitted():
    np.testing.assert_allclose(eager_vicreg_loss(*case(0))[0], vicreg_loss(*case(0))[0], rtol=1e-5)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_vicreg_loss_equal_whitened_views_is_zero(seed):
    z = np.random.default_rng(seed).normal(size=(64, 6))
    z -= z.mean(0)
    z = np.linalg.svd(z, full_matrices=False)[0] * np.sqrt(63)  # covariance exactly the identity
    z = jnp.asarray(z.astype(np.float32))
    np.testing.assert_allclose(vicreg_loss(z, z, jnp.ones(64, bool))[0], 0, atol=1e-6)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_vicreg_loss_reordered_rows_or_swapped_views_is_unchanged(seed):
    z, z_next, valid = case(seed)
    order = np.random.default_rng(seed).permutation(len(z))
    loss = vicreg_loss(z, z_next, valid)[0]
    np.testing.assert_allclose(
        vicreg_loss(z[order], z_next[order], valid[order])[0], loss, rtol=1e-5
    )
    np.testing.assert_allclose(vicreg_loss(z_next, z, valid)[0], loss, rtol=1e-5)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1), st.floats(0.1, 4))
def test_vicreg_loss_scaled_views_terms_grow_with_second_and_fourth_power(seed, scale):
    z, z_next, valid = case(seed)
    small, large = (vicreg_loss(s * z, s * z_next, valid)[1] for s in (1, scale))
    np.testing.assert_allclose(
        large["vicreg_invariance"], scale**2 * small["vicreg_invariance"], rtol=1e-4
    )
    np.testing.assert_allclose(
        large["vicreg_covariance"], scale**4 * small["vicreg_covariance"], rtol=1e-4
    )


def test_vicreg_loss_collapsed_views_is_hinge_of_both():
    z = jnp.ones((8, 3))
    loss = vicreg_loss(z, z, jnp.ones(8, bool))[0]
    np.testing.assert_allclose(loss, 2 * (1 - np.sqrt(1e-4)), rtol=1e-6)


def test_vicreg_loss_no_or_one_valid_row_is_finite():
    z, z_next, valid = case(0)
    none = jnp.zeros_like(valid)
    for rows in (none, none.at[3].set(True)):
        value, gradient = jax.value_and_grad(lambda z, v=rows: vicreg_loss(z, z_next, v)[0])(z)
        assert np.isfinite(value)
        assert np.all(np.isfinite(gradient))
