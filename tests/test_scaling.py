import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sndjax import scale_reward
from sndjax.statistics import init_return_statistics


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1), st.floats(0, 2))
def test_scale_reward_none_multiplies_by_eta_and_clips_at_one(seed, eta):
    signal = np.random.default_rng(seed).exponential(size=(5, 3)).astype(np.float32)
    valid = jnp.ones((5, 3), bool)
    scale = init_return_statistics(3)
    reward, clipped, after = scale_reward(jnp.asarray(signal), valid, scale, "none", eta, 0.99)
    scaled = np.float32(eta) * signal
    np.testing.assert_allclose(reward, np.clip(scaled, 0, 1), rtol=1e-6, atol=1e-30)
    np.testing.assert_array_equal(clipped, scaled > 1)
    assert after is scale


def test_scale_reward_running_std_divides_by_std_of_discounted_sums():
    rng = np.random.default_rng(0)
    signal = rng.exponential(size=(2, 6, 3)).astype(np.float32)
    valid = rng.random((2, 6, 3)) < 0.8
    signal[~valid] = 0
    scale, sums, seen = init_return_statistics(3), np.zeros(3), []
    for part in range(2):
        reward, clipped, scale = scale_reward(
            jnp.asarray(signal[part]), jnp.asarray(valid[part]), scale, "running_std", 5.0, 0.9
        )
        for t in range(6):
            sums = np.where(valid[part, t], 0.9 * sums + signal[part, t], sums)
            seen += list(sums[valid[part, t]])
        np.testing.assert_allclose(reward, 5 * signal[part] / np.std(seen), rtol=1e-4)
        assert not np.any(clipped)
    assert np.max(reward) > 1  # there is no clip
