import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.rollouts import KINDS, rollout
from hypothesis import given, settings
from hypothesis import strategies as st

from sndjax import EncoderView, Features, make_module, re3
from sndjax import neighbour_distance as eager_distance
from sndjax.grid import OBJECTIVES, make_encoder_and_predictor

neighbour_distance = jax.jit(eager_distance, static_argnames=("k", "average"))
VECTOR = KINDS[2]


def in_numpy(z, valid, k, average=False):
    """Sort all distances to the other valid rows in float64; return the k-th, or the mean of k."""
    z = np.asarray(z, np.float64)
    wanted = np.zeros(len(z))
    for i in range(len(z)):
        others = [np.linalg.norm(z[i] - z[j]) for j in range(len(z)) if valid[j] and j != i]
        if others:
            nearest = sorted(others)[:k]
            wanted[i] = np.mean(nearest) if average else nearest[-1]
    return wanted


@settings(deadline=None, max_examples=20)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([1, 3]),
    st.sampled_from([0.0, 0.3, 1.0]),
    st.booleans(),
)
def test_neighbour_distance_random_rows_equals_brute_force(seed, k, chance, average):
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(20, 4)).astype(np.float32)
    valid = rng.random(20) < chance
    got = np.asarray(neighbour_distance(jnp.asarray(z), jnp.asarray(valid), k=k, average=average))
    np.testing.assert_allclose(got[valid], in_numpy(z, valid, k, average)[valid], rtol=1e-5)


@pytest.mark.parametrize("far", [10.0, 1000.0])
def test_neighbour_distance_tight_clusters_far_apart_is_exact(far):
    """One centre for all is not enough: a product's rounding hides the distances in a cluster."""
    rng = np.random.default_rng(0)
    centres = far * rng.normal(size=(6, 8))
    z = (centres[rng.integers(0, 6, 300)] + 0.01 * rng.normal(size=(300, 8))).astype(np.float32)
    got = neighbour_distance(jnp.asarray(z), jnp.ones(300, bool), k=3)
    np.testing.assert_allclose(got, in_numpy(z, np.ones(300, bool), 3), rtol=1e-5)


def test_neighbour_distance_under_vmap_and_with_duplicates_equals_brute_force():
    rng = np.random.default_rng(0)
    z = rng.normal(size=(2, 90, 4)).astype(np.float32)
    z[0, 40:60] = z[0, :20]  # duplicates
    z[1, 45:] = 1000 + 0.01 * rng.normal(size=(45, 4))  # a tight cluster far away
    got = jax.vmap(lambda z: neighbour_distance(z, jnp.ones(90, bool), k=3))(jnp.asarray(z))
    for one, rows in zip(got, z, strict=True):
        np.testing.assert_allclose(one, in_numpy(rows, np.ones(90, bool), 3), rtol=1e-5)


def test_re3_default_reward_does_not_depend_on_the_scale_of_features():
    rng = np.random.default_rng(0)
    made = rollout(VECTOR, rng)
    z = rng.normal(size=(8, 4, 6))

    def read(signal, scale):
        features = jnp.asarray(scale * z, jnp.float32)
        view = EncoderView(lambda x: x, lambda frame, action=None: (frame, frame))
        _, state = signal.init(
            jax.random.key(0), features[0], Features(features[0], *3 * [None]), 3
        )
        padded = jnp.concatenate([features, features[:1]])
        reward, _ = signal.reward({}, state, view, made._replace(frames=padded), jax.random.key(0))
        return np.asarray(reward)[np.asarray(made.valid)]

    rewards = [read(re3(), scale) for scale in (1e-3, 1.0, 100.0)]
    np.testing.assert_allclose(rewards[0], rewards[1], rtol=1e-3)
    np.testing.assert_allclose(rewards[2], rewards[1], rtol=1e-3)
    paper = re3(k=3, average=False, normalize=False)  # eq. 4.46 as printed
    assert read(paper, 100.0).mean() > 100 * read(paper, 1e-3).mean()


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
    distance = in_numpy(z, valid, 4, average=True)[valid]
    wanted = np.log(distance / distance.std() + 1)
    np.testing.assert_allclose(np.asarray(reward).ravel()[valid], wanted, rtol=1e-3)
