"""The settings that others run PPO with, each against an outside reference."""

import functools

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from gymnasium.wrappers.vector import NormalizeObservation, NormalizeReward
from helpers.agents import batch_for, equal, example, made
from helpers.rollouts import KINDS
from test_ppo import case

import sndjax
from sndjax import ppo
from sndjax.acting import normalize_observations
from sndjax.scaling import normalize_rewards
from sndjax.statistics import init_unit_statistics, update_running_statistics
from sndjax.types import ReturnStatistics
from sndjax.updates import minibatch_orders

pytestmark = pytest.mark.usefixtures("quick_compilation")
VECTOR = KINDS[2]


def numpy_loss(c, hyper):
    """Compute OpenAI baselines' loss in float64, on the valid rows."""
    rows = np.asarray(c["valid"])
    x = {k: np.asarray(v, np.float64)[rows] for k, v in c.items() if k not in ("action", "valid")}
    action, n = np.asarray(c["action"])[rows], rows.sum()
    log_p = x["logits"] - np.log(np.exp(x["logits"]).sum(-1, keepdims=True))
    ratio = np.exp(log_p[np.arange(n), action] - x["old_log_prob"])
    a = x["advantage"]
    if hyper.normalize_over == "minibatch":
        a = (a - a.mean()) / (a.std() + 1e-8)
    policy = np.maximum(-a * ratio, -a * np.clip(ratio, 1 - hyper.clip, 1 + hyper.clip)).mean()
    error = (x["value"] - x["target"]) ** 2
    moved = np.clip(x["value"] - x["old_value"], -hyper.value_clip, hyper.value_clip)
    larger = np.maximum(error, (x["old_value"] + moved - x["target"]) ** 2)
    if not hyper.clip_int_value:
        larger[:, 1] = error[:, 1]
    entropy = -(np.exp(log_p) * log_p).sum(-1).mean()
    value = larger.mean(0).sum()
    return policy + hyper.value_weight * value - hyper.entropy_weight * entropy


@pytest.mark.parametrize("both", [True, False])
@pytest.mark.parametrize("seed", range(5))
def test_ppo_loss_clipped_values_and_minibatch_advantages_equal_float64(seed, both):
    hyper = ppo.Hyperparameters(
        normalize_advantages=True,
        normalize_over="minibatch",
        value_clip=0.2,
        clip_int_value=both,
    )
    rng = np.random.default_rng(seed + 100)
    c = case(seed) | {"old_value": jnp.asarray(rng.normal(size=(16, 2)).astype(np.float32))}
    total, _ = ppo.loss(**c, hyper=hyper)
    np.testing.assert_allclose(total, numpy_loss(c, hyper), rtol=1e-4)


def test_combine_rewards_sum_and_product_have_values_by_hand():
    ext, novelty = jnp.array([[2.0, -16.0, 0.0, 1.0]]), jnp.array([[16.0, 81.0, 5.0, -3.0]])
    combine = lambda **changes: ppo.combine_rewards(ppo.Hyperparameters(**changes), ext, novelty)
    got = combine(combine="sum", ext_weight=1.0, int_weight=0.5)
    np.testing.assert_allclose(got, [[10.0, 24.5, 2.5, -0.5]])
    got = combine(combine="product", ext_exponent=0.75)  # eq. 4.32
    np.testing.assert_allclose(got, [[2**0.75 * 2, -8 * 3, 0, 0]], rtol=1e-6)
    got = combine(combine="product", ext_exponent=1.0)
    np.testing.assert_allclose(got, ext)


def test_compute_advantages_one_reward_of_both_needs_one_value_head():
    hyper = ppo.Hyperparameters(combine="sum")
    with pytest.raises(ValueError, match="combine='sum' needs value_heads=1, not 2"):
        ppo.compute_advantages(hyper, batch_for(VECTOR), jnp.zeros((8, 4)))


def test_train_step_sum_without_a_bonus_learns_the_policy_of_plain_ppo_bit_for_bit():
    plain, start, _ = made("ppo", VECTOR, ext_weight=1.0)
    agent, *_ = made("snd_vic", VECTOR, ext_weight=1.0, combine="sum")
    agent = agent._replace(network=plain.network, intrinsic=agent.intrinsic._replace(eta=0.0))
    init = jax.jit(functools.partial(sndjax.init_train_state, agent))
    state = init(jax.random.key(0), example(VECTOR))
    batch = batch_for(VECTOR, heads=1)
    summed, _, _ = jax.jit(sndjax.make_train_step(agent))(state, batch)
    alone, _, _ = jax.jit(sndjax.make_train_step(plain))(start, batch)
    for a, b in zip(jax.tree.leaves(summed.policy), jax.tree.leaves(alone.policy), strict=True):
        np.testing.assert_array_equal(a, b)


class Steps(gymnasium.vector.VectorEnv):
    """Environments that give what they are told, with next-step resets."""

    def __init__(self, obs, reward, terminated, truncated):
        self.metadata = {"autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP}
        self.rows = list(zip(obs[1:], reward, terminated, truncated, strict=True))
        self.opening, self.num_envs = obs[0], reward.shape[1]
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, obs.shape[2:])
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, obs.shape[1:])

    def reset(self, *, seed=None, options=None):
        return self.opening, {}

    def step(self, actions):
        return (*self.rows.pop(0), {})


def test_normalize_rewards_equal_those_of_gymnasiums_wrapper():
    rng = np.random.default_rng(0)
    # One rollout of all rows in which every reset row follows a done.
    steps = 60
    reward = rng.normal(3, 2, (steps, 4)).astype(np.float32)
    ended = rng.random((steps, 4)) < 0.2
    valid = np.ones((steps, 4), bool)
    for t in range(1, steps):
        valid[t] = ~(ended[t - 1] & valid[t - 1])
    ended &= valid
    cut = ended & (rng.random((steps, 4)) < 0.5)
    reward[~valid] = 0
    obs = np.zeros((steps + 1, 4, 2), np.float32)
    wrapped = NormalizeReward(Steps(obs, reward, ended & ~cut, cut), gamma=0.9)
    wrapped.reset()
    wanted = np.stack([wrapped.step(None)[1] for _ in range(steps)])
    scale = ReturnStatistics(init_unit_statistics(()), jnp.zeros(4))
    halves = []
    for part in (slice(0, 25), slice(25, steps)):
        arguments = (jnp.asarray(x[part]) for x in (reward, ended & ~cut, valid))
        got, scale = normalize_rewards(*arguments, scale, 0.9)
        halves.append(np.asarray(got))
    np.testing.assert_allclose(np.concatenate(halves)[valid], wanted[valid], rtol=1e-4)
    assert (~valid).sum() > 20


def test_normalize_observations_equal_those_of_gymnasiums_wrapper_after_its_update():
    rng = np.random.default_rng(0)
    obs = rng.normal(5, 3, (31, 4, 2)).astype(np.float32)
    no = np.zeros((30, 4), bool)
    wrapped = NormalizeObservation(Steps(obs, np.zeros((30, 4)), no, no))
    wrapped.reset()
    for _ in range(30):
        wanted, *_ = wrapped.step(None)
    moments = update_running_statistics(
        init_unit_statistics((2,)), jnp.asarray(obs), jnp.ones((31, 4), bool)
    )
    got = normalize_observations(jnp.asarray(obs[-1]), moments)
    np.testing.assert_allclose(got, wanted, rtol=1e-4, atol=1e-5)
    far = normalize_observations(jnp.full((1, 2), 1e9), moments)
    np.testing.assert_array_equal(far, 10)


def test_init_train_state_normalised_pixels_are_refused():
    agent, *_ = made("ppo", KINDS[0])
    agent = agent._replace(ppo=agent.ppo._replace(normalize_observations=True))
    with pytest.raises(ValueError, match="vectors of floats, not uint8"):
        sndjax.init_train_state(agent, jax.random.key(0), example(KINDS[0]))


def test_train_step_observations_are_normalised_by_those_of_earlier_iterations():
    agent, state, step = made("ppo", VECTOR, normalize_observations=True)
    batch = batch_for(VECTOR, heads=1)
    after, *_ = step(state, batch)
    rows = np.asarray(batch.rollout.frames[:-1])[np.asarray(batch.rollout.valid)]
    np.testing.assert_allclose(after.observations.mean, rows.mean(0), rtol=1e-3, atol=1e-5)
    # The first iteration sees frames as they are: mean 0, variance 1.
    plain = sndjax.make_train_step(
        agent._replace(ppo=agent.ppo._replace(normalize_observations=False))
    )
    wanted, *_ = jax.jit(plain)(state, batch)
    equal(after.policy, wanted.policy, rtol=1e-4, atol=1e-6)


def test_train_step_target_kl_stops_after_the_epoch_that_exceeds_it():
    batch = batch_for(VECTOR, heads=1)
    run = lambda **changes: made("ppo", VECTOR, **changes)[2](
        made("ppo", VECTOR, **changes)[1], batch
    )
    stopped, metrics, _ = run(target_kl=1e-9)
    assert metrics["epochs_run"] == 1
    agent, state, _ = made("ppo", VECTOR)
    one = sndjax.make_train_step(agent._replace(ppo=agent.ppo._replace(epochs=1)))
    wanted, *_ = jax.jit(one)(state, batch)
    equal(stopped.policy, wanted.policy)
    all_run, metrics, _ = run(target_kl=1e9)
    assert metrics["epochs_run"] == 2
    wanted, *_ = run()
    equal(all_run.policy, wanted.policy, rtol=1e-5, atol=1e-7)


def test_minibatch_orders_each_epoch_is_a_permutation_and_they_differ_if_wanted():
    batch = batch_for(VECTOR)
    for each in (False, True):
        agent, *_ = made("ppo", VECTOR, shuffle_each_epoch=each)
        orders = np.asarray(minibatch_orders(agent, batch, jax.random.key(1)))
        assert orders.shape == (2, 4, 8)
        for epoch in orders:
            np.testing.assert_array_equal(np.sort(epoch.ravel()), np.arange(32))
        assert (orders[0] == orders[1]).all() != each


def test_train_step_annealed_learning_rates_scale_adams_steps_by_the_iteration():
    """With one step an iteration, the parameters move by (1 - i/4) times Adam's own step."""
    changes = {"anneal_iterations": 4, "adam_eps": 1e-3, "max_grad_norm": 1e9}
    agent, *_ = made("ppo", VECTOR)
    hyper = agent.ppo._replace(minibatch_size=32, epochs=1, **changes)
    agent = agent._replace(ppo=hyper)
    state = sndjax.init_train_state(agent, jax.random.key(0), example(VECTOR))
    step = jax.jit(sndjax.make_train_step(agent))
    adam = optax.adam(optax.linear_schedule(1e-3, 0, 4), eps=1e-3)
    optimizer, policy = adam.init(state.policy), state.policy

    def loss(params, batch):
        logits, value = agent.network.apply(params, batch.rollout.frames[:-1].reshape(32, -1))
        advantage, target = ppo.compute_advantages(hyper, batch, jnp.zeros((8, 4)))
        flat = lambda x: x.reshape(32, *x.shape[2:])
        made = batch.rollout
        return ppo.loss(
            logits, value, flat(made.action), flat(batch.log_prob), flat(advantage),
            flat(target), flat(made.valid), hyper,
        )[0]  # fmt: skip

    slope = jax.jit(jax.grad(loss))
    for i in range(6):
        batch = batch_for(VECTOR, i, heads=1)
        updates, optimizer = adam.update(slope(policy, batch), optimizer)
        policy = optax.apply_updates(policy, updates)
        state, metrics, _ = step(state, batch)
        assert metrics["learning_rate"] == pytest.approx(1e-3 * max(0, 1 - i / 4))
        equal(state.policy, policy, rtol=1e-3, atol=1e-6)


def test_update_intrinsic_module_two_epochs_are_two_passes():
    agent, state, _ = made("snd_vic", VECTOR)
    batch = batch_for(VECTOR)
    update = lambda epochs, state: sndjax.updates.update_intrinsic_module(
        agent._replace(intrinsic=agent.intrinsic._replace(epochs=epochs)),
        state,
        batch,
        jax.random.key(0),
    )[0]
    twice = jax.jit(functools.partial(update, 2))(state)
    once = jax.jit(functools.partial(update, 1))
    again = once(state._replace(**once(state)._asdict()))
    equal(twice.intrinsic, again.intrinsic, rtol=1e-5, atol=1e-7)
