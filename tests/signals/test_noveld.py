import jax
import jax.numpy as jnp
import numpy as np
from helpers.rollouts import KINDS, rollout
from hypothesis import given, settings
from hypothesis import strategies as st

from sndjax import EncoderView, Features, Rollout, make_module, noveld, noveld_reward
from sndjax.grid import OBJECTIVES, make_encoder_and_predictor
from sndjax.signals.noveld import centre_by_episode, init_centre
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
    assert after.signal.centre is None
    novelty = (difference**2).mean(-1).reshape(9, 4)
    code = np.asarray(target) @ np.asarray(state.signal.projection) > 0
    names = np.unique(code, axis=0, return_inverse=True)[1].reshape(9, 4)
    new, _ = in_numpy(np.zeros((4, 36)), names, made)
    wanted = np.where(new, np.maximum(novelty[1:] - 0.5 * novelty[:-1], 0), 0)
    np.testing.assert_allclose(reward, wanted, rtol=1e-4, atol=1e-6)


def test_centre_by_episode_random_rollouts_equals_a_loop():
    """Subtract the mean of all valid states seen when the episode opened, one row at a time."""
    rng = np.random.default_rng(3)
    centre, seen, own = init_centre(4, 3), [], None
    for _ in range(4):
        made = rollout(VECTOR, rng)
        z = (5 + rng.normal(size=(9, 4, 3))).astype(np.float32)
        first, valid = np.asarray(made.first), np.asarray(made.valid)
        seen.append(z[:-1][valid])
        mean = np.concatenate(seen).mean(0)
        own = np.tile(mean, (4, 1)) if own is None else own
        got, centre = jax.jit(centre_by_episode)(jnp.asarray(z), centre, made)
        for t in range(8):
            for n in range(4):
                if not valid[t, n]:
                    continue
                if first[t, n]:
                    own[n] = mean
                    np.testing.assert_allclose(got[t, n], z[t, n] - mean, rtol=1e-4, atol=1e-5)
                np.testing.assert_allclose(
                    got[t + 1, n], z[t + 1, n] - own[n], rtol=1e-4, atol=1e-5
                )
        np.testing.assert_allclose(centre.mean, own, rtol=1e-5)


def test_noveld_states_of_one_long_episode_are_new_once():
    """Walk over 64 states in four environments for 20 rollouts: at most 256 first visits."""
    rng = np.random.default_rng(0)
    states = 3 + rng.normal(size=(64, 16)).astype(np.float32)
    view = EncoderView(lambda x: x, lambda frame, action=None: (frame, frame))
    _, predictor = make_encoder_and_predictor(
        OBJECTIVES["vicreg"], VECTOR.size, "elu", "asymmetric"
    )
    signal = noveld(predictor, alpha=0.0)
    frames = jnp.asarray(states[:4])
    example = Features(*4 * [jnp.zeros((1, 16))])
    params, state = signal.init(jax.random.key(0), frames, example, 3)
    no, visits = jnp.zeros((50, 4), bool), 0
    read = jax.jit(lambda state, made: signal.reward(params, state, view, made, jax.random.key(0)))
    for part in range(20):
        walked = jnp.asarray(states[rng.integers(0, 64, (51, 4))])
        rows = (no.at[0].set(part == 0), no, ~no)
        reward, state = read(state, Rollout(walked, jnp.zeros((50, 4), jnp.int32), *rows))
        visits += int((reward > 0).sum())
    assert 230 < visits <= 256
