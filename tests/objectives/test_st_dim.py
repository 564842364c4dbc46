import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers.rollouts import NO_ROLLOUT, no_encode
from hypothesis import given, settings
from hypothesis import strategies as st

from sndjax import Features, Transition, st_dim
from sndjax import st_dim_loss as eager_st_dim_loss
from sndjax.objectives.st_dim import contrast as eager_contrast
from sndjax.objectives.st_dim import feature_std_over_dims

st_dim_loss = jax.jit(eager_st_dim_loss, static_argnames=("norm_weight", "spread_weight"))
contrast = jax.jit(eager_contrast)


def in_numpy(local, local_mapped, global_mapped, z, valid, beta_1=1e-4, beta_2=1e-4):
    """Compute eq. 5.1-5.6 in float64, one position and one row at a time."""
    rows = [b for b in range(len(z)) if valid[b]]
    local, local_mapped, global_mapped, z = (
        np.asarray(x, np.float64) for x in (local, local_mapped, global_mapped, z)
    )
    _, height, width, _ = local.shape
    cross = norms = 0.0
    for i in range(height):
        for j in range(width):
            f = np.array([[local[b, i, j] @ local_mapped[c, i, j] for c in rows] for b in rows])
            g = np.array([[local[b, i, j] @ global_mapped[c] for c in rows] for b in rows])
            for logits in (f, g):
                for k in range(len(rows)):
                    softmax = np.exp(logits[k]) / np.exp(logits[k]).sum()
                    cross -= np.log(softmax[k]) / len(rows)
                norms += np.sqrt((logits**2).sum())
    spread = np.mean([z[b].std(ddof=1) for b in rows])
    return (cross + beta_1 * norms) / (height * width) - beta_2 * spread


def case(seed, rows=6, side=(2, 3), channels=4, width=5):
    rng = np.random.default_rng(seed)
    f = lambda *shape: jnp.asarray(rng.normal(size=shape).astype(np.float32))
    valid = rng.random(rows) < 0.7
    valid[0] = True
    return (
        f(rows, *side, channels),
        f(rows, *side, channels),
        f(rows, channels),
        f(rows, width),
        jnp.asarray(valid),
    )


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-4, 0.3]))
def test_st_dim_loss_random_features_equals_equations_in_float64(seed, beta):
    args = case(seed)
    got = st_dim_loss(*args, norm_weight=beta, spread_weight=beta)[0]
    np.testing.assert_allclose(got, in_numpy(*args, beta, beta), rtol=2e-4)


@pytest.mark.parametrize("side", [(1, 1), (12, 12), (5, 5), (7, 1)])
def test_st_dim_loss_slices_of_positions_equal_all_positions_at_once(side):
    args = case(0, side=side)
    np.testing.assert_allclose(st_dim_loss(*args)[0], in_numpy(*args), rtol=2e-4)


def test_st_dim_loss_without_jit_equals_jitted():
    np.testing.assert_allclose(eager_st_dim_loss(*case(0))[0], st_dim_loss(*case(0))[0], rtol=1e-5)


def test_contrast_all_rows_valid_equals_cross_entropy_of_optax():
    local, mapped, *_ = case(1)
    flat = lambda x: x.reshape(len(x), -1, x.shape[-1])
    ours = contrast(flat(local), flat(mapped), jnp.ones(len(local), bool))[0]
    logits = jnp.einsum("bpc,kpc->pbk", flat(local), flat(mapped))
    theirs = optax.softmax_cross_entropy_with_integer_labels(
        logits, jnp.tile(jnp.arange(len(local)), (logits.shape[0], 1))
    )
    np.testing.assert_allclose(ours, theirs.mean(), rtol=1e-5)


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 2**32 - 1))
def test_st_dim_loss_reordered_batch_is_unchanged(seed):
    args = case(seed)
    order = np.random.default_rng(seed).permutation(len(args[0]))
    np.testing.assert_allclose(
        st_dim_loss(*(x[order] for x in args))[0], st_dim_loss(*args)[0], rtol=1e-4
    )


@settings(deadline=None, max_examples=15)
@given(st.sampled_from([2, 7, 40]), st.integers(1, 40))
def test_st_dim_loss_zero_logits_is_log_of_valid_candidates(rows, valid):
    valid = jnp.arange(rows) < valid
    zero = jnp.zeros((rows, 2, 2, 3))
    _, metrics = st_dim_loss(zero, zero, zero[:, 0, 0], jnp.zeros((rows, 4)), valid)
    for name in ("st_dim_global_local", "st_dim_local_local", "st_dim_chance"):
        np.testing.assert_allclose(metrics[name], np.log(valid.sum()), atol=1e-5)


def test_contrast_equal_states_softmax_runs_over_next_states():
    """For each s_t (row), the softmax is over the candidate next states (columns)."""
    local = jnp.array([[[1.0, 0]], [[1.0, 0]]])  # both states are equal
    candidate = jnp.array([[[5.0, 0]], [[0.0, 0]]])  # the first next state has the larger logit
    entropy, _ = contrast(local, candidate, jnp.ones(2, bool))
    row = np.log(np.exp(5) + 1)
    np.testing.assert_allclose(entropy, ((row - 5) + (row - 0)) / 2, rtol=1e-5)
    entropy, _ = contrast(candidate, local, jnp.ones(2, bool))  # arguments swapped: uniform
    np.testing.assert_allclose(entropy, np.log(2), rtol=1e-5)


def test_st_dim_loss_zero_norm_and_standard_deviation_has_zero_gradient():
    rows = 4
    args = [jnp.zeros((rows, 1, 1, 3)), jnp.zeros((rows, 1, 1, 3)), jnp.zeros((rows, 3))]
    loss = lambda *xs: st_dim_loss(*xs, jnp.ones(rows, bool))[0]
    for gradient in jax.grad(loss, (0, 1, 2, 3))(*args, jnp.ones((rows, 5))):
        np.testing.assert_array_equal(gradient, 0)


def test_feature_std_over_dims_valid_rows_equals_numpy_std():
    z = jnp.asarray(np.random.default_rng(0).normal(size=(3, 7)).astype(np.float32))
    got = feature_std_over_dims(z, jnp.array([True, True, False]))
    np.testing.assert_allclose(got, np.std(np.asarray(z[:2]), axis=1, ddof=1).mean(), rtol=1e-5)


def test_st_dim_objective_maps_features_of_next_state():
    """Compare the objective with the equation, its linear maps applied in NumPy."""
    rng = np.random.default_rng(0)
    f = lambda *shape: jnp.asarray(rng.normal(size=shape).astype(np.float32))
    rows = 6
    features = Features(f(rows, 5), f(rows, 5), f(rows, 2, 2, 4), f(rows, 2, 2, 4))
    objective = st_dim()
    params = objective.init(jax.random.key(0), features, 3)
    dense = {k: v["params"]["Dense_0"] for k, v in params.items()}
    for fan_in, name in ((5, "global"), (4, "local")):
        for part in dense[name].values():
            assert np.abs(part).max() <= 1 / np.sqrt(fan_in)
            assert np.abs(part).max() > 0.5 / np.sqrt(fan_in)
    mapped = lambda x, name: (
        np.asarray(x) @ np.asarray(dense[name]["kernel"]) + np.asarray(dense[name]["bias"])
    )
    valid = jnp.ones(rows, bool)
    batch = Transition(None, None, None, None, valid)
    got, _ = objective.loss(params, no_encode, features, batch, NO_ROLLOUT, jax.random.key(1))
    wanted = in_numpy(
        features.local,
        mapped(features.local_next, "local"),
        mapped(features.z_next, "global"),
        features.z,
        valid,
    )
    np.testing.assert_allclose(got, wanted, rtol=1e-4)
