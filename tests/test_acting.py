import jax
import jax.numpy as jnp
import numpy as np

from sndjax.acting import scale_vectors
from sndjax.statistics import init_running_statistics, update_running_statistics


def test_scale_vectors_no_component_is_large_and_centred_ones_have_deviation_one():
    """A mean of many deviations may not be large after scaling; others are x / deviation."""
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(60, 64, 6))
    centre = np.array([0.0, 3.0, 9.81, 9.81, 1e6, 101325.0])
    spread = np.array([2.0, 1.0, 9.81 * 2e-6, 9.81 * 1e-4, 0.0, 100.0])
    x = jnp.asarray(centre + spread * noise, jnp.float32)
    valid = jnp.ones((60, 64), bool)
    moments = jax.jit(update_running_statistics)(init_running_statistics((6,)), x, valid)
    scaled = np.asarray(scale_vectors(x, moments, (True,) * 6))
    assert np.abs(scaled).max() < 11
    wanted = np.asarray(x, np.float64)
    wanted = wanted / wanted.std((0, 1))
    np.testing.assert_allclose(scaled[..., :2], wanted[..., :2], rtol=1e-3)
    np.testing.assert_array_equal(scale_vectors(x, moments, (False,) * 6), x)
