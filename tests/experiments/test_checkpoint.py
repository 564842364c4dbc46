import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sndjax
from experiments.checkpoint import KEEP, Checkpoints
from experiments.training import first_states
from sndjax.algorithms import NAMED


def first_state(name, width=16):
    size = sndjax.VECTOR._replace(features=width, hidden=(8, 8))
    make = NAMED[name]
    motivation = sndjax.Motivation(make(3, size)) if make else None
    network = sndjax.ActorCritic(size, 3, 2 if make else 1)
    agent = sndjax.Agent(network, sndjax.Hyperparameters(), motivation)
    return first_states(agent, [0, 1], jnp.zeros((4, 2)))


@pytest.mark.parametrize("name", NAMED)
def test_a_state_comes_back_bit_for_bit(name, tmp_path):
    state = first_state(name)
    checkpoints = Checkpoints(tmp_path)
    assert checkpoints.restore(jax.eval_shape(lambda x: x, state)) is None
    for iteration in (1, 2, 3):
        checkpoints.save(iteration, state._replace(iteration=state.iteration + iteration))
    checkpoints.close()
    again = Checkpoints(tmp_path)
    assert len(again.manager.all_steps()) == KEEP
    iteration, restored = again.restore(jax.eval_shape(lambda x: x, state))
    again.close()
    assert iteration == 3
    state = state._replace(iteration=state.iteration + 3)
    assert jax.tree.structure(state) == jax.tree.structure(restored)
    raw = lambda tree: tree._replace(key=jax.random.key_data(tree.key))
    for one, other in zip(jax.tree.leaves(raw(state)), jax.tree.leaves(raw(restored)), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
