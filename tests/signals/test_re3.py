import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.rollouts import KINDS, rollout
from hypothesis import given, settings
from hypothesis import strategies as st

from sndjax import make_module
from sndjax import neighbour_distance as eager_distance
from sndjax.grid import OBJECTIVES, make_encoder_and_predictor

neighbour_distance = jax.jit(eager_distance, static_argnames="k")
VECTOR = KINDS[2]


def in_numpy(z, valid, k):
    """Sort all distances to the other valid rows in float64, and return the k-th."""
    z = np.asarray(z, np.float64)
    wanted = np.zeros(len(z))
    for i in range(len(z)):
        others = [np.linalg.norm(z[i] - z[j]) for j in range(len(z)) if valid[j] and j != i]
        if others:
            wanted[i] = sorted(others)[min(k, len(others)) - 1]
    return wanted


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 3]), st.sampled_from([0.0, 0.3, 1.0]))
def test_neighbour_distance_random_rows_equals_brute_force(seed, k, chance):
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(20, 4)).astype(np.float32)
    valid = rng.random(20) < chance
    got = np.asarray(neighbour_distance(jnp.asarray(z), jnp.asarray(valid), k=k))
    np.testing.assert_allclose(got[valid], in_numpy(z, valid, k)[valid], rtol=1e-5)


@pytest.mark.parametrize("rows", [1, 2, 511, 512, 513, 1100])
def test_neighbour_distance_any_number_of_rows_covers_every_row(rows):
    z = np.random.default_rng(0).normal(size=(rows, 3)).astype(np.float32)
    got = neighbour_distance(jnp.asarray(z), jnp.ones(rows, bool), k=2)
    np.testing.assert_allclose(got, in_numpy(z, np.ones(rows, bool), 2), rtol=1e-5)


def test_neighbour_distance_near_neighbours_far_from_zero_is_exact():
    """Squares of 1e4 would lose small distances to rounding; squares of differences do not."""
    z = jnp.asarray([[1e4, 0], [1e4, 0.01], [1e4, 0.03], [-1e4, 0]], jnp.float32)
    got = neighbour_distance(z, jnp.ones(4, bool), k=2)[:3]
    np.testing.assert_allclose(got, [0.03, 0.02, 0.03], rtol=1e-3)


def test_neighbour_distance_garbage_in_invalid_rows_changes_nothing():
    z = np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32)
    valid = np.arange(9) % 3 != 0
    clean = neighbour_distance(jnp.asarray(z), jnp.asarray(valid))
    z[~valid] = np.nan
    dirty = neighbour_distance(jnp.asarray(z), jnp.asarray(valid))
    np.testing.assert_array_equal(np.asarray(clean)[valid], np.asarray(dirty)[valid])


def test_re3_reward_is_log_of_neighbour_distance_of_features():
    """Compare with eq. 4.46 on the frozen encoder's features of the valid s_t."""
    made = rollout(VECTOR, np.random.default_rng(0))
    module = make_module("none", "re3", VECTOR.actions, VECTOR.size)
    params, state = jax.jit(module.init)(jax.random.key(0), made.frames[0])
    reward, _ = jax.jit(module.reward)(params, state, made, jax.random.key(1))
    encoder, _ = make_encoder_and_predictor(OBJECTIVES["none"], VECTOR.size, "elu", "asymmetric")
    z, _ = encoder.apply(state.encoder, made.frames[:-1].reshape(32, -1))
    valid = np.asarray(made.valid).ravel()
    wanted = np.log(in_numpy(z, valid, 3) + 1)
    np.testing.assert_allclose(np.asarray(reward).ravel()[valid], wanted[valid], rtol=1e-3)
