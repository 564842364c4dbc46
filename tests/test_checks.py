import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.rollouts import KINDS, rollout

from sndjax import (
    ATARI,
    VECTOR,
    ActorCritic,
    check_rollout,
    gather_transitions,
    make_module,
    rnd,
    slice_transitions,
    snd_vic,
)
from sndjax.checks import check_images
from sndjax.convolution import to_float

MADE = rollout(KINDS[2], np.random.default_rng(0))  # T = 8, N = 4, three actions


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"action": jnp.zeros((8, 4, 1), jnp.int32)}, "rollout.action has shape (8, 4, 1)"),
        ({"done": jnp.zeros((4, 8), bool)}, "rollout.done has shape (4, 8)"),
        ({"frames": jnp.zeros((8, 4, 5))}, "one frame more than steps"),
        ({"valid": jnp.zeros(32, bool)}, "must be [T, N]"),
        ({"action": MADE.action.at[2, 1].set(7)}, "action 7 does not exist: there are 3, 0 to 2"),
        ({"action": MADE.action.at[2, 1].set(-1)}, "action -1 does not exist"),
    ],
)
def test_check_rollout_wrong_array_is_named(change, message):
    valid = MADE.valid.at[2, 1].set(True)
    with pytest.raises(ValueError, match=re.escape(message)):
        check_rollout(MADE._replace(**{"valid": valid} | change), 3)


def test_check_rollout_impossible_action_of_an_invalid_row_is_allowed():
    made = MADE._replace(action=MADE.action.at[2, 1].set(99), valid=MADE.valid.at[2, 1].set(False))
    check_rollout(made, 3)
    module = make_module("vicreg", "prediction", 3, KINDS[2].size)
    params, state = module.init(jax.random.key(0), made.frames[0])
    reward, _ = module.reward(params, state, made, jax.random.key(1))
    assert np.all(np.isfinite(reward))


def test_module_reward_impossible_action_is_refused():
    module = make_module("none", "prediction", 3, KINDS[2].size)
    params, state = module.init(jax.random.key(0), MADE.frames[0])
    made = MADE._replace(action=jnp.full_like(MADE.action, 7))
    with pytest.raises(ValueError, match="action 7 does not exist"):
        module.reward(params, state, made, jax.random.key(1))


def test_gather_transitions_row_that_does_not_exist_is_refused_or_not_valid():
    with pytest.raises(ValueError, match="row 2000 does not exist: there are 32, 0 to 31"):
        gather_transitions(MADE, jnp.array([0, 2000]))
    with pytest.raises(ValueError, match="row -1 does not exist"):
        gather_transitions(MADE, jnp.array([-1]))
    everything = MADE._replace(valid=jnp.ones_like(MADE.valid))
    inside = jax.jit(gather_transitions)(everything, jnp.array([3, 2000, -1]))
    assert inside.valid.tolist() == [True, False, False]


def test_gather_and_slice_transitions_actions_of_rank_three_are_refused():
    vectors = MADE._replace(action=jnp.zeros((8, 4, 2), jnp.int32))
    for take in (
        lambda: gather_transitions(vectors, jnp.arange(4)),
        lambda: slice_transitions(vectors, jnp.int32(0), 4),
    ):
        with pytest.raises(Exception, match=r"rollout.action has shape|Type-check error"):
            take()


@pytest.mark.parametrize("shape", [(4, 3, 84, 84), (2, 1, 210, 160), (2, 12, 64, 64)])
def test_check_images_channels_first_are_refused(shape):
    with pytest.raises(ValueError, match="channels first"):
        check_images(jnp.zeros(shape, jnp.uint8))
    with pytest.raises(ValueError, match="channels first"):
        snd_vic(5, ATARI).init(jax.random.key(0), jnp.zeros(shape, jnp.uint8))
    with pytest.raises(ValueError, match="channels first"):
        ActorCritic(ATARI, 5).init(jax.random.key(0), jnp.zeros(shape, jnp.uint8))


@pytest.mark.parametrize(
    "shape", [(84, 84, 3), (96, 96, 1), (7, 7, 3), (24, 24, 48), (9, 11, 83), (12, 16, 20)]
)
def test_check_images_channels_last_pass(shape):
    check_images(jnp.zeros((2, *shape), jnp.uint8))


def test_snd_vic_vectors_with_the_size_of_pixels_are_refused_with_what_to_write():
    with pytest.raises(ValueError, match=r"take size=sndjax\.VECTOR"):
        snd_vic(3).init(jax.random.key(0), jnp.zeros((4, 5)))
    snd_vic(3, VECTOR).init(jax.random.key(0), jnp.zeros((4, 5)))


def test_rnd_integer_pixels_of_any_width_have_the_signal_of_uint8():
    """int32 pixels of 0 to 255 were read unscaled, with a signal 10^4 times too large."""
    kind = KINDS[1]
    made = rollout(kind, np.random.default_rng(0))
    signals = []
    for dtype in (jnp.uint8, jnp.int32, jnp.uint16):
        pixels = made._replace(frames=made.frames.astype(dtype))
        module = rnd(kind.actions, kind.size)
        params, state = jax.jit(module.init)(jax.random.key(0), pixels.frames[0])
        signals.append(jax.jit(module.reward)(params, state, pixels, jax.random.key(1))[0])
    np.testing.assert_allclose(signals[1], signals[0], rtol=1e-5)
    np.testing.assert_allclose(signals[2], signals[0], rtol=1e-5)


def test_check_images_bright_floats_are_refused_where_their_values_are_known():
    bright = jnp.full((2, 64, 64, 3), 200.0)
    with pytest.raises(ValueError, match="hold 200: pixels of 0 to 255 must be integers"):
        check_images(bright)
    jax.jit(check_images)(bright)  # values are not known
    check_images(bright / 255)


def test_to_float_small_grids_of_integers_keep_their_values():
    grid = jnp.full((2, 7, 7, 3), 10, jnp.int32)
    np.testing.assert_array_equal(to_float(grid), 10)
    np.testing.assert_allclose(to_float(jnp.full((2, 16, 16, 3), 51, jnp.int32)), 0.2)
