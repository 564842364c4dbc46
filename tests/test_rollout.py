import jax.numpy as jnp
import numpy as np
import pytest
from helpers.rollouts import KINDS, experience, rollout

from sndjax.rollout import (
    FrameStack,
    gather_transitions,
    make_frame_stacker,
    map_over_time,
    push_frame,
    slice_transitions,
    stack_to_channels,
    zero_invalid_rows,
)

ATARI = KINDS[0]


def test_gather_transitions_any_index_gives_rows_of_rollout():
    made = rollout(ATARI, np.random.default_rng(0), steps=5, envs=3)
    index = jnp.array([7, 0, 14, 7])
    batch = gather_transitions(made, index)
    for row, i in enumerate(index):
        t, n = divmod(int(i), 3)
        np.testing.assert_array_equal(batch.frame[row], made.frames[t, n])
        np.testing.assert_array_equal(batch.next_frame[row], made.frames[t + 1, n])
        for name in ("action", "first", "done", "valid"):
            assert getattr(batch, name)[row] == getattr(made, name)[t, n]


def test_slice_transitions_has_each_frame_once_and_equals_gather_transitions():
    made = rollout(ATARI, np.random.default_rng(0), steps=5, envs=3)
    for start, rows in ((0, 6), (3, 9), (4, 5), (2, 2)):
        got = slice_transitions(made, jnp.int32(start), rows)
        assert got.frames.shape[0] == rows + 3
        wanted = gather_transitions(made, jnp.arange(start, start + rows))
        for name in ("frame", "next_frame", "action", "first", "done", "valid"):
            np.testing.assert_array_equal(getattr(got, name), getattr(wanted, name))


def test_zero_invalid_rows_clears_invalid_rows_and_no_others():
    made = rollout(KINDS[2], np.random.default_rng(0), chance=0.5)
    batch = gather_transitions(made, jnp.arange(made.action.size))
    dirty = batch._replace(
        frames=jnp.where(jnp.tile(batch.valid, 2)[:, None], batch.frames, jnp.nan)
    )
    clean = zero_invalid_rows(dirty)
    valid = np.asarray(batch.valid)
    assert not valid.all()
    np.testing.assert_array_equal(clean.frame[valid], batch.frame[valid])
    assert np.all(np.asarray(clean.frame[~valid]) == 0)
    assert np.all(np.asarray(clean.next_frame[~valid]) == 0)


@pytest.mark.parametrize("stack", [FrameStack(4, True), FrameStack(2, False), FrameStack(1, True)])
@pytest.mark.parametrize("seed", range(5))
def test_make_frame_stacker_minibatch_equals_stacks_pushed_while_acting(stack, seed):
    rng = np.random.default_rng(seed)
    steps, envs = 12, 3
    batch = experience(ATARI, rng, steps, envs, stack.size)
    made = batch.rollout
    # The stacks while acting: the window before this rollout, then one frame after another.
    window = jnp.concatenate([batch.history[:1], batch.history, made.frames[:1]])[-stack.size :]
    window = jnp.concatenate([window[:1], window[:-1]])
    seen = []
    for t in range(steps):
        window = push_frame(window, made.frames[t], made.first[t], stack.repeat)
        if t == 0:
            batch = batch._replace(history=window[:-1])
        seen.append(stack_to_channels(window))
    wanted = jnp.stack(seen).reshape(steps * envs, *seen[0].shape[1:])
    index = jnp.asarray(rng.permutation(steps * envs))
    valid = np.asarray(made.valid).reshape(-1)[np.asarray(index)]
    got = make_frame_stacker(batch, stack)(index)
    np.testing.assert_array_equal(got[valid], wanted[index][valid])


def test_push_frame_new_episode_holds_no_frame_of_the_last_one():
    old, new = jnp.full((3, 2, 1), 7, jnp.uint8), jnp.full((2, 1), 9, jnp.uint8)
    first = jnp.array([True, False])
    repeated = push_frame(old, new, first, True)
    zeros = push_frame(old, new, first, False)
    np.testing.assert_array_equal(repeated[:, 0, 0], [9, 9, 9])
    np.testing.assert_array_equal(zeros[:, 0, 0], [0, 0, 9])
    for window in (repeated, zeros):
        np.testing.assert_array_equal(window[:, 1, 0], [7, 7, 9])


@pytest.mark.parametrize(("steps", "envs"), [(7, 3), (6, 400), (1, 1)])
def test_map_over_time_any_shape_applies_to_every_frame(steps, envs):
    x = np.random.default_rng(0).normal(size=(steps, envs, 2)).astype(np.float32)
    got = map_over_time(lambda frames: frames.sum(-1), jnp.asarray(x))
    np.testing.assert_allclose(got, x.sum(-1), rtol=1e-5)
