import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sndjax.hashing import random_projection, simhash_code


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1e3))
def test_simhash_code_scaled_vectors_equals_signs_as_binary_number(seed, scale):
    rng = np.random.default_rng(seed)
    z, a = rng.normal(size=(3, 5, 4)).astype(np.float32), rng.normal(size=(4, 9)).astype(np.float32)
    wanted = [[sum(2**i for i in range(9) if row @ a[:, i] > 0) for row in rows] for rows in z]
    np.testing.assert_array_equal(simhash_code(jnp.asarray(z), jnp.asarray(a)), wanted)
    np.testing.assert_array_equal(simhash_code(jnp.asarray(scale * z), jnp.asarray(a)), wanted)


def test_simhash_code_share_of_different_signs_is_angle_over_pi():
    """Check the property that defines SimHash (Charikar, 2002)."""
    a = random_projection(jax.random.key(0), 8, 14)
    rng = np.random.default_rng(0)
    for angle in (0.3, 1.0, 2.5):
        x, y = np.linalg.qr(rng.normal(size=(8, 2)))[0].T
        shares = []
        for k in range(200):
            a = random_projection(jax.random.key(k), 8, 14)
            pair = jnp.asarray(np.stack([x, np.cos(angle) * x + np.sin(angle) * y]), jnp.float32)
            one, other = (int(c) for c in simhash_code(pair, a))
            shares.append(bin(one ^ other).count("1") / 14)
        assert abs(np.mean(shares) - angle / np.pi) < 0.03


def test_random_projection_many_vectors_keeps_squared_length_on_average():
    a = np.asarray(random_projection(jax.random.key(0), 200, 64))
    x = np.random.default_rng(0).normal(size=(500, 200))
    ratio = (x @ a**1) ** 2
    np.testing.assert_allclose(ratio.sum(1).mean() / (x**2).sum(1).mean(), 1, rtol=0.1)
