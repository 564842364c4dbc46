import jax
import jax.numpy as jnp
import numpy as np
from helpers.rollouts import KINDS, NO_ROLLOUT, no_encode, rollout
from hypothesis import given, settings
from hypothesis import strategies as st

from sndjax import (
    Features,
    TargetNetwork,
    Transition,
    byol,
    byol_distance,
    gather_transitions,
    snd_byol,
)

VECTOR = KINDS[2]


def in_numpy(q, z, valid):
    """Compute eq. 3.9 in float64."""
    q, z = (np.asarray(x, np.float64)[np.asarray(valid)] for x in (q, z))
    unit = lambda x: x / np.linalg.norm(x)
    return np.mean([((unit(a) - unit(b)) ** 2).sum() for a, b in zip(q, z, strict=True)])


def normal(rng, *shape):
    return jnp.asarray(rng.normal(size=shape).astype(np.float32))


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1), st.floats(0.01, 100))
def test_byol_distance_vectors_of_any_length_equals_equation_in_float64(seed, scale):
    rng = np.random.default_rng(seed)
    q, z, valid = normal(rng, 6, 4), normal(rng, 6, 4), jnp.arange(6) != 2
    np.testing.assert_allclose(byol_distance(q, z, valid), in_numpy(q, z, valid), rtol=1e-4)
    np.testing.assert_allclose(
        byol_distance(scale * q, z, valid), byol_distance(q, z, valid), rtol=1e-3, atol=1e-5
    )


def test_byol_distance_known_vectors_has_known_values_and_no_target_gradient():
    one = jnp.array([[1.0, 0.0]])
    yes = jnp.ones(1, bool)
    for other, value in ((one, 0), (jnp.array([[0.0, 2.0]]), 2), (-one, 4)):
        np.testing.assert_allclose(byol_distance(one, other, yes), value, atol=1e-6)
    both = jax.grad(lambda q, z: byol_distance(q, z, yes), (0, 1))(one, jnp.array([[1.0, 1.0]]))
    assert np.any(both[0])
    assert not np.any(both[1])
    assert np.all(np.isfinite(jax.grad(lambda q: byol_distance(q, one, yes))(0 * one)))


def perceptron(params, x):
    layers = params["params"]
    for i in range(len(layers)):
        dense = layers[f"Dense_{i}"]
        x = (np.maximum(x, 0) if i else x) @ np.asarray(dense["kernel"], np.float64)
        x = x + np.asarray(dense["bias"], np.float64)
    return x


def test_byol_loss_each_view_predicts_slow_network_of_other_view():
    """Compare with eq. 3.10, its heads in NumPy; the slow encoder here doubles the frame."""
    rng = np.random.default_rng(0)
    frame, next_frame = normal(rng, 5, 6), normal(rng, 5, 6)
    features = Features(frame, next_frame, None, None)
    objective = byol()
    params, slow = (objective.init(jax.random.key(k), features, 3) for k in (0, 1))
    valid = jnp.arange(5) < 4
    batch = Transition(jnp.concatenate([frame, next_frame]), None, None, None, valid)
    target = TargetNetwork(slow, lambda x: (2 * x, None))
    key = jax.random.key(2)
    got, _ = objective.loss(params, no_encode, features, batch, NO_ROLLOUT, key, target=target)
    wanted = 0.0
    for mine, other in ((frame, next_frame), (next_frame, frame)):
        online = perceptron(params.predictor, perceptron(params.projector, np.asarray(mine)))
        wanted += in_numpy(online, perceptron(slow.projector, 2 * np.asarray(other)), valid)
    np.testing.assert_allclose(got, wanted, rtol=1e-4)


def test_snd_byol_update_moves_slow_encoder_and_heads_which_get_no_gradient():
    batch = rollout(VECTOR, np.random.default_rng(0))
    module = snd_byol(VECTOR.actions, VECTOR.size)
    params, state = jax.jit(module.init)(jax.random.key(0), batch.frames[0])
    for part in ("encoder", "objective"):
        jax.tree.map(
            np.testing.assert_array_equal, getattr(state.slow, part), getattr(params, part)
        )
    moved = jax.tree.map(lambda x: x + 1.0, params)
    after = module.update(moved, state)
    for part in ("encoder", "objective"):
        jax.tree.map(
            lambda slow, old: np.testing.assert_allclose(slow, old + 0.01, atol=1e-6),
            getattr(after.slow, part), getattr(params, part),
        )  # fmt: skip
    # The slow encoder changes the loss, and is not among the differentiated parameters.
    rows, key = gather_transitions(batch, jnp.arange(32)), jax.random.key(2)
    loss = jax.jit(module.loss)
    assert loss(params, state, rows, batch, key)[0] != loss(params, after, rows, batch, key)[0]
    assert params._fields == ("encoder", "objective", "signal")
