import jax.numpy as jnp
import numpy as np

from sndjax.preprocessing import make_preprocess
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
