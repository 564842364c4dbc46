import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.agents import batch_for, equal, made
from helpers.rollouts import KINDS

import sndjax

VECTOR = KINDS[-1]
pytestmark = pytest.mark.usefixtures("quick_compilation")


@pytest.fixture(scope="module")
def both():
    """Return a state, a batch, and `train_step` without and with the guard."""
    _, state, step = made("snd_vic", VECTOR)
    return state, batch_for(VECTOR), step, jax.jit(sndjax.skip_nonfinite(step))


def without_key(state):
    return state._replace(key=(), iteration=())


def test_skip_nonfinite_finite_numbers_changes_nothing(both):
    state, batch, step, guarded = both
    after, metrics, reward = step(state, batch)
    same, more, again = guarded(state, batch)
    equal(after, same)
    np.testing.assert_array_equal(reward, again)
    assert float(more.pop("skipped")) == 0
    equal(metrics, more)


@pytest.mark.parametrize("where", ["reward", "log_prob", "value", "frames", "weights"])
@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_skip_nonfinite_nan_or_inf_keeps_state_and_reports_skipped(both, where, number):
    state, batch, _, guarded = both
    rollout = batch.rollout
    t, n = np.argwhere(np.asarray(rollout.valid))[3]
    if where == "frames":
        rollout = rollout._replace(frames=rollout.frames.at[t, n, 0].set(number))
        batch = batch._replace(rollout=rollout)
    elif where == "weights":
        first, *rest = jax.tree.leaves(state.intrinsic)
        broken = jax.tree.unflatten(jax.tree.structure(state.intrinsic), [first * number, *rest])
        state = state._replace(intrinsic=broken)
    else:
        column = getattr(batch, where)
        batch = batch._replace(**{where: column.at[t, n].set(number)})
    after, metrics, reward = guarded(state, batch)
    assert float(metrics["skipped"]) == 1
    assert bool(jnp.isfinite(reward).all())
    equal(without_key(after), without_key(state))
    assert int(after.iteration) == int(state.iteration) + 1
    assert not (jax.random.key_data(after.key) == jax.random.key_data(state.key)).all()


def test_skip_nonfinite_under_vmap_skips_each_seed_separately(both):
    state, batch, step, _ = both
    two = lambda tree: jax.tree.map(lambda x: jnp.stack([x, x]), tree)
    batches = two(batch)
    batches = batches._replace(reward=batches.reward.at[1].set(jnp.nan))
    after, metrics, _ = jax.jit(jax.vmap(sndjax.skip_nonfinite(step)))(two(state), batches)
    plain = jax.jit(jax.vmap(step))(two(state), batches)[0]
    assert metrics["skipped"].tolist() == [0, 1]
    pick = lambda tree, i: jax.tree.map(lambda x: x[i], tree)
    equal(without_key(pick(after, 1)), without_key(state))
    equal(pick(after, 0), pick(plain, 0))
