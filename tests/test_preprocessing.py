import jax.numpy as jnp
import numpy as np

from sndjax.convolution import to_float
from sndjax.preprocessing import make_preprocess
from sndjax.statistics import init_running_statistics, update_running_statistics
from sndjax.types import RunningStatistics


def test_make_preprocess_none_mean_standardize_equal_numpy():
    x = np.random.default_rng(0).integers(0, 256, (50, 3), dtype=np.uint8)
    samples = x.astype(np.float64) / 255
    m2 = ((samples - samples.mean(0)) ** 2).sum(0)
    moments = RunningStatistics(jnp.float32(50), jnp.float32(samples.mean(0)), jnp.float32(m2))
    assert make_preprocess("none", None)(x) is x
    centred = make_preprocess("mean", moments)(jnp.asarray(x))
    np.testing.assert_allclose(centred, samples - samples.mean(0), atol=1e-6)
    standard = make_preprocess("standardize", moments)(jnp.asarray(x))
    wanted = np.clip((samples - samples.mean(0)) / samples.std(0), -1, 1)
    np.testing.assert_allclose(standard, wanted, atol=1e-5)
    assert np.abs(wanted).max() == 1


def test_make_preprocess_standardize_gray_levels_that_never_change_are_zero():
    """Of 256 constant pixels, one of each level, none may be read as a deviation."""
    levels = jnp.arange(256, dtype=jnp.uint8).reshape(1, 1, 16, 16, 1)
    moments = init_running_statistics((16, 16, 1))
    for _ in range(10):
        frames = jnp.broadcast_to(levels, (4, 100, 16, 16, 1))
        moments = update_running_statistics(moments, frames, jnp.ones((4, 100), bool), to_float)
    read = make_preprocess("standardize", moments)(levels[0])
    np.testing.assert_allclose(read, 0, atol=1e-6)
