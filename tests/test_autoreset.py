"""Tests of rollouts made from loops that reset within the step: rewards are those of the layout."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.rollouts import KINDS, frames

import sndjax
from sndjax import Rollout, from_autoreset, make_module
from sndjax.grid import SIGNALS

pytestmark = pytest.mark.usefixtures("quick_compilation")
VECTOR = KINDS[2]
STEPS, ENVS = 16, 4


def steps_of_two_rollouts(rng, steps=STEPS, envs=ENVS):
    """Return obs, next_obs, action, done of two rollouts in a row, NumPy arrays of [2T, N].

    Episodes end together: what signals average over environments, they then average alike.
    """
    done = np.repeat(rng.random((2 * steps, 1)) < 0.08, envs, axis=1)
    done[steps - 1] = True  # an episode that ends with the first rollout
    obs, next_obs = (frames(rng, VECTOR.shape, 2 * steps, envs) for _ in range(2))
    for t in range(2 * steps - 1):
        inside = ~done[t]
        obs[t + 1][inside] = next_obs[t][inside]
    action = rng.integers(0, VECTOR.actions, done.shape).astype(np.int32)
    return obs, next_obs, action, done


def native_rollout(rng, obs, next_obs, action, done, opens):
    """Write the same transitions with a reset row after each end, a loop over environments.

    Environments have different numbers of reset rows; rows that are not valid fill up the end.

    Returns:
      The rollout, and the row of every transition.
    """
    steps, envs = done.shape
    rows = 2 * steps - 1  # as many as the woven ones: XLA multiplies matrices of one size alike
    seen = frames(rng, VECTOR.shape, rows + 1, envs)
    acted = rng.integers(0, VECTOR.actions, (rows, envs)).astype(np.int32)
    first, ends, valid = (np.zeros((rows, envs), bool) for _ in range(3))
    where = np.zeros((steps, envs), int)
    for n in range(envs):
        row, opening = 0, opens[n]
        for t in range(steps):
            seen[row, n], seen[row + 1, n] = obs[t, n], next_obs[t, n]
            acted[row, n], first[row, n], ends[row, n] = action[t, n], opening, done[t, n]
            valid[row, n] = True
            where[t, n] = row
            opening = done[t, n]
            row += 2 if done[t, n] else 1  # the row between them is a reset
    return Rollout(*map(jnp.asarray, (seen, acted, first, ends, valid))), where


@pytest.mark.parametrize("signal", SIGNALS)
@pytest.mark.parametrize("objective", ["none", "vicreg", "inverse_dynamics"])
def test_from_autoreset_rewards_are_those_of_the_native_layout_bit_for_bit(objective, signal):
    rng = np.random.default_rng(len(signal))
    data = steps_of_two_rollouts(rng)
    module = make_module(objective, signal, VECTOR.actions, VECTOR.size)
    params, state = module.init(jax.random.key(0), jnp.asarray(data[0][0]))
    read = jax.jit(module.reward)
    mine = theirs = state
    opens, seen = np.ones(ENVS, bool), []
    for half in (slice(0, STEPS), slice(STEPS, 2 * STEPS)):
        part = [x[half] for x in data]
        key = jax.random.key(half.start)
        woven = from_autoreset(*map(jnp.asarray, part), jnp.asarray(opens))
        native, where = native_rollout(rng, *part, opens)
        got, mine = read(params, mine, woven, key)
        wanted, theirs = read(params, theirs, native, key)
        np.testing.assert_array_equal(got[::2], np.take_along_axis(np.array(wanted), where, 0))
        assert not got[1::2].any()
        seen.append(got[::2])
        opens = part[3][-1]
    jax.tree.map(np.testing.assert_array_equal, mine, theirs)
    assert np.ptp(seen) > 0


def test_from_autoreset_without_first_opens_an_episode_everywhere():
    obs, next_obs, action, done = map(jnp.asarray, steps_of_two_rollouts(np.random.default_rng(0)))
    rollout = from_autoreset(obs, next_obs, action, done)
    assert rollout.first[0].all()
    np.testing.assert_array_equal(rollout.first[2::2], done[:-1])
    np.testing.assert_array_equal(rollout.done[::2], done)
    assert not rollout.valid[1::2].any()


def test_from_autoreset_of_one_step_is_a_batch_of_transitions():
    rng = np.random.default_rng(1)
    obs, next_obs = (jnp.asarray(frames(rng, (5,), 1, 6)) for _ in range(2))
    action, done = jnp.zeros((1, 6), jnp.int32), jnp.zeros((1, 6), bool)
    rollout = from_autoreset(obs, next_obs, action, done)
    assert rollout.valid.shape == (1, 6)
    batch = sndjax.gather_transitions(rollout, jnp.arange(6))
    np.testing.assert_array_equal(batch.frame, obs[0])
    np.testing.assert_array_equal(batch.next_frame, next_obs[0])
