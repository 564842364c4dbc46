import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.agents import equal
from helpers.corridors import corridor, play_in_python
from hypothesis import given, settings
from hypothesis import strategies as st

import sndjax
from sndjax.jax_environment import check_environment, environment_keys, reset_ended

STEPS, ENVS = 40, 5
CORRIDOR = corridor()
RESET = jax.jit(functools.partial(reset_ended, CORRIDOR))
SIZE = sndjax.VECTOR._replace(hidden=(8,), features=8)


def agent_of(stack=1, num_actions=2):
    network = sndjax.ActorCritic(SIZE, num_actions, 1)
    return sndjax.AgentSpec(network, sndjax.Hyperparameters(), stack=sndjax.FrameStack(stack))


def start(agent, env, seed=0, envs=ENVS):
    """Return the actor and the environments of a seed."""
    live = sndjax.init_environments(env, jax.random.key(100 + seed), envs, agent.stack.size)
    state = sndjax.init_train_state(agent, jax.random.key(seed), live.frame)
    return sndjax.Actor(state.policy, state.observations, state.key), live


def collector(agent, env, steps=STEPS):
    return jax.jit(lambda actor, live, key: sndjax.collect(agent, env, actor, live, key, steps))


def test_collect_equals_a_loop_over_single_environments():
    agent, env = agent_of(), corridor()
    actor, live = start(agent, env)
    key = jax.random.key(7)
    batch, after = collector(agent, env)(actor, live, key)
    rollout = batch.rollout
    keys = jnp.stack([environment_keys(jax.random.fold_in(key, t), ENVS) for t in range(STEPS)])
    begun = environment_keys(jax.random.key(100), ENVS)
    frames, columns = play_in_python(env, begun, np.asarray(rollout.action), keys)
    np.testing.assert_array_equal(rollout.frames, frames)
    for name in ("done", "valid", "first"):
        np.testing.assert_array_equal(getattr(rollout, name), columns[name].astype(bool), name)
    np.testing.assert_array_equal(batch.reward, columns["reward"].astype(np.float32))
    np.testing.assert_array_equal(batch.truncated, columns["truncated"].astype(bool))
    assert (~rollout.valid).sum() > 3 * ENVS  # resets
    assert batch.truncated.sum() > 3
    assert (rollout.done & ~batch.truncated).sum() > 3
    np.testing.assert_array_equal(after.frame, frames[-1])


def test_collect_in_two_parts_continues_the_environments():
    agent, env = agent_of(), corridor()
    actor, live = start(agent, env)
    collect = collector(agent, env, 9)
    one, live = collect(actor, live, jax.random.key(1))
    two, _ = collect(actor, live, jax.random.key(2))
    np.testing.assert_array_equal(one.rollout.frames[-1], two.rollout.frames[0])
    reset_row = np.asarray(one.rollout.done[-1])
    np.testing.assert_array_equal(two.rollout.valid[0], ~reset_row)


def test_collect_values_and_log_probabilities_are_those_of_the_policy():
    agent, env = agent_of(stack=3), corridor()
    actor, live = start(agent, env)
    batch, _ = collector(agent, env)(actor, live, jax.random.key(7))
    stacks = sndjax.rollout.make_frame_stacker(batch, agent.stack)
    logits, value = agent.network.apply(actor.policy, stacks(jnp.arange(STEPS * ENVS)))
    valid = np.asarray(batch.rollout.valid)
    wanted = np.asarray(value).reshape(STEPS, ENVS, 1)
    np.testing.assert_allclose(batch.value[:-1][valid], wanted[valid], atol=1e-6)
    log_prob = jax.nn.log_softmax(logits)[jnp.arange(STEPS * ENVS), batch.rollout.action.ravel()]
    wanted = np.asarray(log_prob).reshape(STEPS, ENVS)
    np.testing.assert_allclose(batch.log_prob[valid], wanted[valid], atol=1e-6)


def test_collect_under_vmap_equals_one_agent_after_another():
    agent, env = agent_of(), corridor()
    starts = [start(agent, env, seed) for seed in range(3)]
    keys = jax.random.split(jax.random.key(7), 3)
    collect = collector(agent, env)
    together = jax.tree.map(lambda *x: jnp.stack(x), *starts)
    got = jax.jit(jax.vmap(collect))(*together, keys)
    for i, own in enumerate(starts):
        batch, live = jax.tree.map(lambda x, i=i: x[i], got)
        wanted_batch, wanted_live = collect(*own, keys[i])
        equal((batch.rollout, live), (wanted_batch.rollout, wanted_live))
        np.testing.assert_allclose(batch.value, wanted_batch.value, atol=1e-6)


@given(st.lists(st.booleans(), min_size=37, max_size=37), st.integers(0, 100))
@settings(max_examples=40, deadline=None)
def test_reset_ended_resets_those_alone_with_their_own_keys(ended, seed):
    env, count = CORRIDOR, len(ended)
    keys = environment_keys(jax.random.key(seed), count)
    state, frame = jax.vmap(env.reset)(environment_keys(jax.random.key(seed + 1), count))
    got = RESET(jnp.array(ended), keys, (state, frame))
    fresh = jax.vmap(env.reset)(keys)
    for old, new, found in zip(
        *(jax.tree.leaves(x) for x in ((state, frame), fresh, got)), strict=True
    ):
        if jnp.issubdtype(old.dtype, jax.dtypes.prng_key):
            old, new, found = map(jax.random.key_data, (old, new, found))
        old, new, found = map(np.asarray, (old, new, found))
        for i, reset in enumerate(ended):
            np.testing.assert_array_equal(found[i], (new if reset else old)[i])


def test_reset_ended_resets_no_more_than_it_must():
    count = 300
    counted = []
    plain = corridor()

    def reset(key):
        jax.debug.callback(lambda word: counted.append(word), jax.random.key_data(key)[0])
        return plain.reset(key)

    env = plain._replace(reset=reset)
    keys = environment_keys(jax.random.key(0), count)
    live = jax.vmap(plain.reset)(keys)
    ended = jnp.zeros((2, count), bool).at[0, 5].set(True).at[1, 250].set(True)
    twice = jax.tree.map(lambda x: jnp.stack([x, x]), (keys, live))
    call = jax.jit(jax.vmap(lambda e, k, x: reset_ended(env, e, k, x)))
    jax.block_until_ready(jax.tree.leaves(call(ended, *twice))[0])
    jax.effects_barrier()
    assert 2 <= len(counted) <= 8  # of 600: one chunk of all seeds' environments


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frame": lambda x: x.astype(jnp.int32)}, r"observation is float32\[2\] after reset"),
        ({"state": lambda x: {"at": x["at"]}}, "state of another structure"),
        ({"state": lambda x: x | {"time": x["time"] * 1.0}}, r"state\['time'\] is int32\[\]"),
        ({"reward": lambda x: x[None]}, r"reward of shape \(1,\)"),
    ],
)
def test_check_environment_names_what_does_not_fit(change, message):
    plain = corridor()

    def step(key, state, action):
        state, frame, reward, *flags = plain.step(key, state, action)
        parts = {"state": state, "frame": frame, "reward": reward}
        for name, function in change.items():
            parts[name] = function(parts[name])
        return *parts.values(), *flags

    with pytest.raises(ValueError, match=message):
        check_environment(plain._replace(step=step))


@pytest.mark.parametrize(
    "given", [{"place": lambda state: 0}, {"num_places": 3}, {"progress": lambda state: 0.0}]
)
def test_check_environment_place_progress_and_number_belong_together(given):
    with pytest.raises(ValueError, match="num_places"):
        check_environment(corridor()._replace(**given))


def test_collect_and_train_step_learn_the_corridor():
    env = corridor(cells=6, limit=12, slip=0.0)
    network = sndjax.ActorCritic(SIZE, 2, 1)
    hyper = sndjax.Hyperparameters(minibatch_size=64, learning_rate=3e-3)
    agent = sndjax.AgentSpec(network, hyper)
    train_step = sndjax.make_train_step(agent)
    _, live = start(agent, env, envs=16)
    state = sndjax.init_train_state(agent, jax.random.key(0), live.frame)

    def iteration(carry, _):
        state, live = carry
        actor = sndjax.Actor(state.policy, state.observations, state.key)
        batch, live = sndjax.collect(agent, env, actor, live, jax.random.fold_in(state.key, 2), 32)
        state, *_ = train_step(state, batch)
        return (state, live), batch.reward.sum() / jnp.maximum(batch.rollout.done.sum(), 1)

    _, mean = jax.jit(lambda c: jax.lax.scan(iteration, c, None, length=30))((state, live))
    assert mean[-1] == pytest.approx(1.5)  # every episode ends at the end
    assert mean[0] < 1.2
