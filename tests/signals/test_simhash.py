from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
from helpers.rollouts import KINDS, rollout

from experiments.config.compose import load_config
from experiments.environments.pools import make_pool
from sndjax import ATARI, EncoderView, Features, Rollout, make_module, simhash
from sndjax.grid import OBJECTIVES, make_encoder_and_predictor

VECTOR = KINDS[2]


def test_simhash_reward_two_rollouts_is_one_over_root_of_count():
    """Compare with eq. 4.18 by a Counter, over two rollouts; reset rows are not counted."""
    options = {"num_hash_bits": 4}
    module = make_module("none", "simhash", VECTOR.actions, VECTOR.size, signal_options=options)
    first = rollout(VECTOR, np.random.default_rng(0))
    params, state = jax.jit(module.init)(jax.random.key(0), first.frames[0])
    encoder, _ = make_encoder_and_predictor(OBJECTIVES["none"], VECTOR.size, "elu", "asymmetric")
    projection = np.asarray(state.signal.projection)
    counts, seen = Counter(), []
    for seed in (0, 1):
        made = rollout(VECTOR, np.random.default_rng(seed))
        reward, state = jax.jit(module.reward)(params, state, made, jax.random.key(1))
        z, _ = encoder.apply(state.encoder, made.frames[:-1].reshape(32, -1))
        valid = np.asarray(made.valid).ravel()
        z = np.asarray(z, np.float64)
        seen.append(z[valid])
        codes = [tuple((row - np.concatenate(seen).mean(0)) @ projection > 0) for row in z]
        counts.update(code for code, v in zip(codes, valid, strict=True) if v)
        wanted = [1 / np.sqrt(max(counts[code], 1)) for code in codes]
        np.testing.assert_allclose(
            np.asarray(reward).ravel()[valid], np.array(wanted)[valid], rtol=1e-5
        )
    assert float(jnp.sum(state.signal.counts)) == sum(counts.values())
    assert max(counts.values()) > 1


def test_simhash_common_mean_of_features_changes_no_count():
    """Add 30 to every feature, as the mean of pixels does: centred codes stay as they are."""
    rng = np.random.default_rng(0)
    made = rollout(VECTOR, rng)
    z = rng.normal(size=(9, 4, 16)).astype(np.float32)

    def codes(signal, features):
        view = EncoderView(lambda x: x, lambda frame, action=None: (frame, frame))
        first = jnp.asarray(features[0])
        _, state = signal.init(jax.random.key(0), first, Features(first, first, first, first), 3)
        read = made._replace(frames=jnp.asarray(features))
        _, state = signal.reward({}, state, view, read, jax.random.key(0))
        return np.asarray(state.counts)

    np.testing.assert_array_equal(codes(simhash(8), z), codes(simhash(8), z + 30))
    plain = simhash(8, centre=False)
    assert np.count_nonzero(codes(plain, z)) > 15
    assert np.count_nonzero(codes(plain, z + 30)) == 1  # every state has one code


def test_simhash_frames_of_montezuma_are_told_apart():
    """Count the codes of 768 frames of random play, with a random encoder of the thesis' size."""
    pool = make_pool(load_config(["env=MontezumaRevenge", "algo=rnd"]).env, [0], 6)
    rng, frames = np.random.default_rng(0), [pool.reset()[0]]
    for _ in range(128):
        frames.append(pool.step(rng.integers(0, 18, (1, 6))).frame[0])
    pixels = np.stack(frames)
    distinct = len(np.unique(pixels[:-1].reshape(768, -1), axis=0))
    no = jnp.zeros((128, 6), bool)
    made = Rollout(jnp.asarray(pixels), jnp.zeros((128, 6), jnp.int32), no, no, ~no)
    codes = {}
    for centre in (False, True):
        module = make_module("none", "simhash", 18, ATARI, signal_options={"centre": centre})
        params, state = jax.jit(module.init)(jax.random.key(0), made.frames[0])
        _, state = jax.jit(module.reward)(params, state, made, jax.random.key(1))
        codes[centre] = int(jnp.sum(state.signal.counts > 0))
    print(f"{distinct} distinct frames; codes without and with centring: {codes}")
    assert codes[False] < 0.1 * distinct
    assert codes[True] > 0.75 * distinct
