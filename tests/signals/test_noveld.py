import jax
import jax.numpy as jnp
import numpy as np
from helpers.rollouts import KINDS, rollout
from hypothesis import given, settings
from hypothesis import strategies as st

from sndjax import make_module, noveld_reward
from sndjax.grid import OBJECTIVES, make_encoder_and_predictor
from sndjax.signals.noveld import first_visits as eager_first_visits

first_visits = jax.jit(eager_first_visits)
VECTOR = KINDS[2]


def in_numpy(visited, code, made):
    """Find first visits with sets, one environment and one step at a time."""
    first, valid = np.asarray(made.first), np.asarray(made.valid)
    seen = [set(np.flatnonzero(row)) for row in np.asarray(visited)]
    new = np.zeros(valid.shape, bool)
    for t in range(len(valid)):
        for n in range(valid.shape[1]):
            if not valid[t, n]:
                continue
            if first[t, n]:
                seen[n] = {code[t, n]}
            new[t, n] = code[t + 1, n] not in seen[n]
            seen[n].add(code[t + 1, n])
    return new, seen


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1))
def test_first_visits_two_rollouts_equals_python_sets(seed):
    rng = np.random.default_rng(seed)
    visited = jnp.zeros((4, 6), bool)
    for _ in range(2):
        made = rollout(VECTOR, rng)
        code = rng.integers(0, 6, (9, 4)).astype(np.int32)
        wanted, sets = in_numpy(visited, code, made)
        new, visited = first_visits(visited, jnp.asarray(code), made)
        np.testing.assert_array_equal(new, wanted)
        assert [set(np.flatnonzero(row)) for row in np.asarray(visited)] == sets


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_noveld_reward_random_novelty_equals_equation(seed, alpha):
    rng = np.random.default_rng(seed)
    novelty, new = rng.random((5, 3)).astype(np.float32), rng.random((4, 3)) < 0.5
    gain = lambda t, n: max(novelty[t + 1, n] - alpha * novelty[t, n], 0)
    wanted = [[gain(t, n) * new[t, n] for n in range(3)] for t in range(4)]
    got = noveld_reward(jnp.asarray(novelty), jnp.asarray(new), alpha)
    np.testing.assert_allclose(got, wanted, rtol=1e-5, atol=1e-6)


def test_noveld_module_reward_is_gain_in_norm_of_distance_at_first_visits():
    made = rollout(VECTOR, np.random.default_rng(0))
    module = make_module("vicreg", "noveld", VECTOR.actions, VECTOR.size)
    params, state = jax.jit(module.init)(jax.random.key(0), made.frames[0])
    reward, _ = jax.jit(module.reward)(params, state, made, jax.random.key(1))
    encoder, learned = make_encoder_and_predictor(
        OBJECTIVES["vicreg"], VECTOR.size, "elu", "asymmetric"
    )
    frames = made.frames.reshape(36, -1)
    target, _ = encoder.apply(params.encoder, frames)
    copy, _ = learned.apply(params.signal, frames)
    difference = np.asarray(copy, np.float64) - np.asarray(target)
    novelty = np.sqrt((difference**2).sum(-1)).reshape(9, 4)
    seen = np.asarray(target, np.float64).reshape(9, 4, -1)
    centred = np.asarray(target) - seen[:-1][np.asarray(made.valid)].mean(0)
    code = centred @ np.asarray(state.signal.projection) > 0
    names = np.unique(code, axis=0, return_inverse=True)[1].reshape(9, 4)
    new, _ = in_numpy(np.zeros((4, 36)), names, made)
    wanted = np.where(new, np.maximum(novelty[1:] - 0.5 * novelty[:-1], 0), 0)
    np.testing.assert_allclose(reward, wanted, rtol=1e-4, atol=1e-6)
    assert np.any(wanted > 0)
    options = {"novelty": "squared", "centre": False}
    before = make_module("vicreg", "noveld", VECTOR.actions, VECTOR.size, signal_options=options)
    _, plain = jax.jit(before.init)(jax.random.key(0), made.frames[0])
    reward, after = jax.jit(before.reward)(params, plain, made, jax.random.key(1))
    assert after.signal.features is None
    novelty = (difference**2).mean(-1).reshape(9, 4)
    code = np.asarray(target) @ np.asarray(state.signal.projection) > 0
    names = np.unique(code, axis=0, return_inverse=True)[1].reshape(9, 4)
    new, _ = in_numpy(np.zeros((4, 36)), names, made)
    wanted = np.where(new, np.maximum(novelty[1:] - 0.5 * novelty[:-1], 0), 0)
    np.testing.assert_allclose(reward, wanted, rtol=1e-4, atol=1e-6)
