import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rlax
from helpers.rollouts import episodes
from hypothesis import given, settings
from hypothesis import strategies as st

from sndjax import generalized_advantage

jitted = jax.jit(generalized_advantage, static_argnums=(4, 5, 7))


def brute_force(reward, value, done, valid, discount, lam, truncated=None, episodic=True):
    """Compute each advantage as an explicit sum over the valid rows from its own row on."""
    steps, envs = reward.shape
    advantage = np.zeros((steps, envs))
    for n in range(envs):
        rows = [t for t in range(steps) if valid[t, n]]
        deltas = []
        for position, t in enumerate(rows):
            following = rows[position + 1] if position + 1 < len(rows) else steps
            after = value[following, n]
            if episodic and done[t, n]:
                after = value[t + 1, n] if truncated is not None and truncated[t, n] else 0
            deltas.append(reward[t, n] + discount * after - value[t, n])
        for position, t in enumerate(rows):
            weight = 1.0
            for later in range(position, len(rows)):
                advantage[t, n] += weight * deltas[later]
                weight *= discount * lam
                if episodic and done[rows[later], n]:
                    break
    return advantage


def case(seed, steps=12, envs=3):
    rng = np.random.default_rng(seed)
    _, done, valid = episodes(rng, steps, envs)
    reward = rng.normal(size=(steps, envs))
    value = rng.normal(size=(steps + 1, envs))
    truncated = done & (rng.random((steps, envs)) < 0.5)
    return reward, value, done, valid, truncated


def on_device(*arrays):
    return [jnp.asarray(x, jnp.float32 if x.dtype == np.float64 else x.dtype) for x in arrays]


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.booleans(), st.booleans())
def test_generalized_advantage_random_episodes_equals_brute_force(seed, bootstrap, episodic):
    reward, value, done, valid, truncated = case(seed)
    limit = truncated if bootstrap else None
    wanted = brute_force(reward, value, done, valid, 0.9, 0.8, limit, episodic)
    args = on_device(reward, value, done, valid)
    got = jitted(*args, 0.9, 0.8, jnp.asarray(truncated) if bootstrap else None, episodic)
    np.testing.assert_allclose(got, wanted, atol=1e-4)


@pytest.mark.parametrize("transform", [lambda f: f, jax.jit])
def test_generalized_advantage_without_reset_rows_equals_rlax(transform):
    reward, value, done, _, _ = case(1)
    valid = np.ones_like(done)
    ours = transform(lambda *a: generalized_advantage(*a, 0.9, 0.8))(
        *on_device(reward, value, done, valid)
    )
    theirs = jax.vmap(
        lambda r, d, v: rlax.truncated_generalized_advantage_estimation(r, d, 0.8, v),
        in_axes=1,
        out_axes=1,
    )(*on_device(reward, 0.9 * (1.0 - done), value))
    np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_generalized_advantage_nan_in_reset_rows_changes_nothing():
    reward, value, done, valid, _ = case(3, steps=30)
    assert (~valid).any()
    clean = generalized_advantage(*on_device(reward, value, done, valid), 0.99, 0.95)
    reward[~valid] = np.nan
    value[:-1][~valid] = np.nan
    done[~valid] = True
    dirty = generalized_advantage(*on_device(reward, value, done, valid), 0.99, 0.95)
    np.testing.assert_array_equal(clean, dirty)
    assert np.all(np.asarray(clean)[~valid] == 0)


def test_generalized_advantage_done_in_last_row_bootstraps_only_if_not_episodic():
    one = jnp.ones((1, 1))
    value = jnp.array([[2.0], [5.0]])
    true = jnp.ones((1, 1), bool)
    assert generalized_advantage(one, value, true, true, 0.5, 1.0)[0, 0] == 1 - 2
    got = generalized_advantage(one, value, true, true, 0.5, 1.0, episodic=False)
    assert got[0, 0] == 1 + 0.5 * 5 - 2
