from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
from helpers.rollouts import KINDS, rollout

from sndjax import make_module
from sndjax.grid import OBJECTIVES, make_encoder_and_predictor

VECTOR = KINDS[2]


def test_simhash_reward_two_rollouts_is_one_over_root_of_count():
    """Compare with eq. 4.18 by a Counter, over two rollouts; reset rows are not counted."""
    module = make_module("none", "simhash", VECTOR.actions, VECTOR.size)
    first = rollout(VECTOR, np.random.default_rng(0))
    params, state = jax.jit(module.init)(jax.random.key(0), first.frames[0])
    encoder, _ = make_encoder_and_predictor(OBJECTIVES["none"], VECTOR.size, "elu", "asymmetric")
    projection = np.asarray(state.signal.projection)
    counts = Counter()
    for seed in (0, 1):
        made = rollout(VECTOR, np.random.default_rng(seed))
        reward, state = jax.jit(module.reward)(params, state, made, jax.random.key(1))
        z, _ = encoder.apply(state.encoder, made.frames[:-1].reshape(32, -1))
        codes = [tuple(np.asarray(row) @ projection > 0) for row in z]
        valid = np.asarray(made.valid).ravel()
        counts.update(code for code, v in zip(codes, valid, strict=True) if v)
        wanted = [1 / np.sqrt(max(counts[code], 1)) for code in codes]
        np.testing.assert_allclose(
            np.asarray(reward).ravel()[valid], np.array(wanted)[valid], rtol=1e-5
        )
    assert float(jnp.sum(state.signal.counts)) == sum(counts.values())
    assert max(counts.values()) > 1
