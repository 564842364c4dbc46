"""The recurrent policy: against the feed-forward one, flax's cell, and a loop over single steps."""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.agents import equal
from helpers.corridors import corridor

import sndjax
from sndjax import actor_critic
from sndjax.acting import unroll
from sndjax.policy_minibatches import minibatch_orders
from sndjax.rollout import make_frame_stacker
from sndjax.updates import update_policy

pytestmark = pytest.mark.usefixtures("quick_compilation")
STEPS, ENVS = 12, 6
SIZE = sndjax.VECTOR._replace(hidden=(8,), features=8)
HYPER = sndjax.Hyperparameters(minibatch_size=STEPS * 2, epochs=2, learning_rate=1e-3)


class Identity(nn.RNNCellBase):
    """A cell whose output is its input."""

    features: int
    recurrent_kernel_init: object = None

    def __call__(self, carry, inputs):
        return carry, inputs

    def initialize_carry(self, rng, input_shape):
        raise NotImplementedError

    @property
    def num_feature_axes(self):
        return 1


def agent_of(memory, stack=2, **changes):
    network = sndjax.ActorCritic(SIZE._replace(memory=memory), 2, 1)
    hyper = HYPER._replace(**changes)
    return sndjax.AgentSpec(network, hyper, stack=sndjax.FrameStack(stack))


def collect(agent, rollouts=1, steps=STEPS, scale=1.0):
    """Return the state, and the last of some rollouts of corridors with short episodes.

    Args:
      agent: what acts.
      rollouts: how many.
      steps: of each.
      scale: of the policy's weights; large ones make an output that depends on the input.
    """
    env = corridor()
    live = sndjax.init_environments(env, jax.random.key(1), ENVS, agent.stack.size, agent.network)
    state = sndjax.init_train_state(agent, jax.random.key(0), live.frame)
    state = state._replace(policy=jax.tree.map(lambda x: scale * x, state.policy))
    actor = sndjax.Actor(state.policy, state.observations, state.key)
    run = jax.jit(lambda live, key: sndjax.collect(agent, env, actor, live, key, steps))
    for i in range(rollouts):
        batch, live = run(live, jax.random.key(2 + i))
    return state, batch, live


def test_identity_cell_acts_and_learns_as_the_feed_forward_policy(monkeypatch):
    monkeypatch.setitem(actor_critic.CELLS, "gru", Identity)
    whole = {"minibatch_size": STEPS * ENVS}  # one minibatch, so that its rows are the same
    (state, batch, _), (plain, wanted, _) = (
        collect(agent_of(memory, **whole), rollouts=2) for memory in ("gru", "none")
    )
    equal(state.policy, plain.policy)
    equal(batch._replace(hidden=None), wanted)
    learn = lambda memory: jax.jit(sndjax.make_train_step(agent_of(memory, **whole)))
    after, metrics, _ = learn("gru")(state, batch)
    other, wanted_metrics, _ = learn("none")(plain, wanted)
    equal(after.policy, other.policy, rtol=1e-4, atol=1e-6)
    equal(metrics, wanted_metrics, rtol=1e-4, atol=1e-6)


def test_unroll_equals_flax_cell_stepped_one_by_one_with_zeros_at_each_episode():
    agent = agent_of("gru", stack=1)
    state, batch, _ = collect(agent, rollouts=3)
    first = np.asarray(batch.rollout.first)
    assert first.sum() > 5
    assert np.abs(batch.hidden).max() > 0.01  # the rollout begins within episodes
    frames = batch.rollout.frames[:-1].reshape(STEPS * ENVS, -1)
    logits, value, hidden = unroll(
        agent.network, state.policy, frames, batch.hidden, batch.rollout.first
    )
    weights = state.policy["params"]
    cell = nn.GRUCell(8)
    carry = batch.hidden
    dense = lambda name, x: x @ weights[name]["kernel"] + weights[name]["bias"][None]
    for t in range(STEPS):
        torso = weights["Torso_0"]["Dense_0"]
        x = nn.relu(batch.rollout.frames[t] @ torso["kernel"] + torso["bias"][None])
        x = dense("Dense_0", x)
        carry = np.where(first[t][:, None], 0, carry)
        carry, x = cell.apply({"params": weights["GRUCell_0"]}, carry, x)
        actor = nn.relu(dense("Dense_1", nn.relu(x)))
        np.testing.assert_allclose(
            logits.reshape(STEPS, ENVS, -1)[t], dense("Dense_2", actor), atol=1e-5
        )
    np.testing.assert_allclose(hidden, carry, atol=1e-5)
    np.testing.assert_allclose(value[:, 0], batch.value[:-1].reshape(-1), atol=1e-5)


def test_first_epoch_on_whole_sequences_has_the_probabilities_of_acting():
    """With the stored state before the rollout and the resets in it, every ratio is 1."""
    agent = agent_of("gru", epochs=1)
    state, batch, _ = collect(agent, rollouts=3, scale=4.0)
    assert (~batch.rollout.valid).sum() > 5
    stacks = make_frame_stacker(batch, agent.stack)(jnp.arange(STEPS * ENVS))
    logits, *_ = unroll(agent.network, state.policy, stacks, batch.hidden, batch.rollout.first)
    log_p = jax.nn.log_softmax(logits)[jnp.arange(STEPS * ENVS), batch.rollout.action.reshape(-1)]
    valid = np.asarray(batch.rollout.valid)
    np.testing.assert_allclose(
        np.asarray(log_p).reshape(STEPS, ENVS)[valid], batch.log_prob[valid], atol=1e-5
    )
    zero = jnp.zeros((STEPS, ENVS))
    frozen = agent._replace(ppo=agent.ppo._replace(learning_rate=0.0))
    batch = sndjax.rollout.zero_reset_rows(batch)
    _, metrics = update_policy(frozen, state, batch, zero, batch.value[:-1], jax.random.key(0))
    assert abs(metrics["kl"]) < 1e-9
    assert metrics["value_loss"] < 1e-10


def test_minibatch_orders_of_sequences_hold_all_steps_of_their_environments():
    agent = agent_of("gru", shuffle_each_epoch=True)
    _, batch, _ = collect(agent)
    orders = np.asarray(minibatch_orders(agent, batch, jax.random.key(0)))
    assert orders.shape == (2, 3, STEPS * 2)
    for epoch in orders:
        np.testing.assert_array_equal(np.sort(epoch.ravel()), np.arange(STEPS * ENVS))
        for rows in epoch.reshape(3, STEPS, 2):
            np.testing.assert_array_equal(rows // ENVS, np.arange(STEPS)[:, None] + 0 * rows)
            assert (rows % ENVS == rows[:1] % ENVS).all()
    with pytest.raises(ValueError, match="12 times a divisor of 6"):
        minibatch_orders(agent_of("gru", minibatch_size=36 // 2), batch, jax.random.key(0))


def test_train_step_moves_every_weight_of_the_cell_and_keeps_the_state_of_the_rollout():
    agent = agent_of("gru")
    state, batch, live = collect(agent, rollouts=2)
    after, metrics, _ = jax.jit(sndjax.make_train_step(agent))(state, batch)
    for old, new in zip(
        jax.tree.leaves(state.policy["params"]["GRUCell_0"]),
        jax.tree.leaves(after.policy["params"]["GRUCell_0"]),
        strict=True,
    ):
        assert (old != new).any()
    assert np.isfinite(list(metrics.values())).all()
    assert live.hidden.shape == (ENVS, 8)


def test_unroll_without_the_state_that_the_policy_needs_is_refused():
    agent = agent_of("gru")
    env = corridor()
    live = sndjax.init_environments(env, jax.random.key(1), ENVS, agent.stack.size)
    state = sndjax.init_train_state(agent, jax.random.key(0), live.frame)
    actor = sndjax.Actor(state.policy, state.observations, state.key)
    with pytest.raises(ValueError, match=r"begin with network\.initial_memory"):
        sndjax.collect(agent, env, actor, live, jax.random.key(2), STEPS)


def test_train_step_two_seeds_under_vmap_equal_each_by_itself():
    agent = agent_of("gru")
    state, batch, _ = collect(agent, rollouts=2)
    step = sndjax.make_train_step(agent)
    both = jax.tree.map(lambda x: jnp.stack([x, x]), (state, batch))
    together, *_ = jax.jit(jax.vmap(step))(*both)
    alone, *_ = jax.jit(step)(state, batch)
    equal(jax.tree.map(lambda x: x[1], together.policy), alone.policy, rtol=1e-4, atol=1e-6)
    init = functools.partial(sndjax.init_train_state, agent)
    keys = jax.random.split(jax.random.key(0), 2)
    states = jax.jit(jax.vmap(lambda key: init(key, batch.rollout.frames[0])))(keys)
    assert states.policy["params"]["GRUCell_0"]["hn"]["kernel"].shape == (2, 8, 8)


def cued_choice(length=4):
    """Return a task whose first observation names the action that is right at its last step."""

    def look(state):
        now = jnp.where(state["time"] == 0, state["cue"] * 2 - 1, 0)
        return jnp.stack([now, state["time"] == length]).astype(jnp.float32)

    def reset(key):
        state = {"cue": jax.random.bernoulli(key).astype(jnp.int32), "time": jnp.int32(0)}
        return state, look(state)

    def step(key, state, action):
        end = state["time"] == length
        reward = (end & (action == state["cue"])).astype(jnp.float32)
        state = state | {"time": state["time"] + 1}
        return state, look(state), reward, end, jnp.zeros((), bool)

    return sndjax.JaxEnvironment(reset, step, num_actions=2)


@pytest.mark.parametrize(("memory", "low", "high"), [("gru", 0.95, 1.0), ("none", 0.3, 0.65)])
def test_a_cue_of_the_first_step_is_remembered_with_a_memory_alone(memory, low, high):
    """Without a memory no policy is right more often than half of the time."""
    env, envs, steps = cued_choice(), 64, 18
    network = sndjax.ActorCritic(SIZE._replace(memory=memory, features=16), 2, 1)
    hyper = sndjax.Hyperparameters(minibatch_size=steps * 16, learning_rate=5e-3, clip=0.2,
                                   gamma_ext=0.95, entropy_weight=0.01)  # fmt: skip
    agent = sndjax.AgentSpec(network, hyper._replace(normalize_advantages=True))
    live = sndjax.init_environments(env, jax.random.key(1), envs, 1, network)
    state = sndjax.init_train_state(agent, jax.random.key(0), live.frame)
    train_step = sndjax.make_train_step(agent)

    @jax.jit
    def train(state, live):
        def iterate(carry, key):
            state, live = carry
            actor = sndjax.Actor(state.policy, state.observations, state.key)
            batch, live = sndjax.collect(agent, env, actor, live, key, steps)
            state, *_ = train_step(state, batch)
            return (state, live), batch.reward.sum() / batch.rollout.done.sum()

        return jax.lax.scan(iterate, (state, live), jax.random.split(jax.random.key(2), 60))[1]

    right = np.asarray(train(state, live))[-10:].mean()
    assert low <= right <= high
