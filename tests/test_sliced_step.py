"""Compare the pieces of `train_step`, in slices of several lengths, with the whole."""

import jax
import jax.numpy as jnp
import pytest
from helpers.agents import batch_for, equal, heads, made
from helpers.rollouts import KINDS

from sndjax.passes import count_steps
from sndjax.sliced_step import make_sliced_step

CASES = [
    ("snd_vic", 2, {}),
    ("ppo", 2, {}),
    ("rnd", 0, {}),
    ("snd_byol", 2, {"target_kl": 1e-9}),
    ("icm", 1, {"anneal_iterations": 4, "normalize_rewards": True}),
]


def learn_in_slices(programs, state, batch, lengths):
    """Return the result of all pieces, whose slices have these lengths in turn."""
    learning, policy, module = programs.begin(state, batch)

    def run(program, done, inputs):
        at, turn = 0, 0
        while inputs is not None and at < count_steps(inputs):
            end = min(at + lengths[turn % len(lengths)], count_steps(inputs))
            done = program(learning, done, jnp.int32(at), jnp.int32(end))
            at, turn = end, turn + 1
        return done

    policy = run(programs.policy, policy, learning.policy_inputs)
    module = run(programs.module, module, learning.module_inputs)
    return programs.finish(learning, policy, module)


@pytest.mark.parametrize(("name", "kind", "changes"), CASES)
def test_make_sliced_step_any_slices_equal_train_step_bit_for_bit(name, kind, changes):
    kind = KINDS[kind]
    agent, _, whole = made(name, kind, **changes)
    _, start, _ = made(name, kind, **changes)
    # The pieces donate what they get, as a run does.
    own, pieces = jax.tree.map(jnp.copy, start), make_sliced_step(agent)
    programs = pieces._replace(
        begin=jax.jit(pieces.begin, donate_argnums=0),
        policy=jax.jit(pieces.policy, donate_argnums=1),
        module=jax.jit(pieces.module, donate_argnums=1),
        finish=jax.jit(pieces.finish, donate_argnums=(1, 2)),
    )
    state = start
    for seed, lengths in enumerate([(1,), (3, 1), (1000,)]):
        batch = batch_for(kind, seed, heads(name))
        state, *expected = whole(state, batch)
        own, *found = learn_in_slices(programs, own, batch, lengths)
        equal((own, found), (state, expected), rtol=0)
    assert int(own.iteration) == 3
