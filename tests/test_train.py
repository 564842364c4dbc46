import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.agents import ENVS, STEPS, batch_for, equal, example, heads, made
from helpers.rollouts import KINDS
from hypothesis import given, settings
from hypothesis import strategies as st

import sndjax
from experiments.training.agents import make_init_states
from experiments.training.seeds import map_over_seeds
from sndjax import ppo
from sndjax.updates import update_intrinsic_module

pytestmark = pytest.mark.usefixtures("quick_compilation")


RUNS = [(name, KINDS[2]) for name in ("ppo", "snd_vic", "snd_byol", "icm", "qrnd")]
RUNS += [("ppo", KINDS[0]), ("snd_std", KINDS[0]), ("rnd", KINDS[1]), ("sp", KINDS[1])]


@pytest.mark.parametrize(("name", "kind"), RUNS, ids=lambda x: getattr(x, "name", x))
def test_train_step_one_call_is_finite_and_changes_trained_parameters(name, kind):
    _, state, step = made(name, kind)
    after, metrics, int_reward = step(state, batch_for(kind, heads=heads(name)))
    for key, value in metrics.items():
        assert value.shape == (), key
        assert np.isfinite(value), key
    assert 0 < metrics["entropy"] <= np.log(kind.actions) + 1e-5
    assert int_reward.shape == (STEPS, ENVS)
    assert after.iteration == 1
    changed = jax.tree.map(lambda a, b: bool(jnp.any(a != b)), state.policy, after.policy)
    assert all(jax.tree.leaves(changed))
    changed = jax.tree.map(
        lambda a, b: a.ndim < 2 or bool(jnp.any(a != b)), state.intrinsic, after.intrinsic
    )
    assert all(jax.tree.leaves(changed))
    # The state keeps its shapes and dtypes, so that its buffers can be donated.
    same = jax.tree.map(lambda a, b: a.shape == b.shape and a.dtype == b.dtype, state, after)
    assert all(jax.tree.leaves(same))
    if name == "rnd":
        equal(state.intrinsic_state.encoder, after.intrinsic_state.encoder)


@pytest.mark.parametrize(
    ("name", "kind"),
    [("ppo", KINDS[2]), ("rnd", KINDS[1]), ("snd_std", KINDS[0]), ("sp_vinv", KINDS[2])],
    ids=lambda x: getattr(x, "name", x),
)
def test_train_step_garbage_in_reset_rows_changes_no_parameter_and_no_metric(name, kind):
    """Fill everything in a reset row, except the frames that it shares with its neighbours."""
    _, state, step = made(name, kind)

    @settings(deadline=None, max_examples=5, database=None)
    @given(st.integers(0, 2**32 - 1))
    def check(seed):
        rng = np.random.default_rng(seed)
        batch = batch_for(kind, seed, heads(name))
        invalid = ~np.asarray(batch.rollout.valid)
        if not invalid.any():
            return
        fill = lambda x, value: jnp.where(jnp.asarray(invalid), jnp.asarray(value, x.dtype), x)
        noise = rng.choice([np.nan, np.inf, -1e30, 1e30], (STEPS, ENVS))
        rollout = batch.rollout._replace(
            action=fill(batch.rollout.action, rng.integers(-9, 99, (STEPS, ENVS))),
            done=batch.rollout.done | invalid,
            first=batch.rollout.first | invalid,
        )
        dirty = batch._replace(
            rollout=rollout,
            reward=fill(batch.reward, noise),
            log_prob=fill(batch.log_prob, noise),
            truncated=batch.truncated | invalid,
            value=batch.value.at[:-1].set(
                jnp.where(
                    jnp.asarray(invalid)[..., None], jnp.asarray(noise)[..., None], batch.value[:-1]
                )
            ),
        )
        equal(step(state, batch), step(state, dirty))

    check()


@pytest.mark.parametrize("name", ["ppo", "snd_v", "snd_byol", "icm"])
def test_train_step_rollout_of_reset_rows_alone_moves_no_weight(name):
    """After a first update Adam has momentum, which would move weights without any gradient."""
    kind = KINDS[2]
    _, state, step = made(name, kind)
    state, *_ = step(state, batch_for(kind, heads=heads(name)))
    batch = batch_for(kind, 1, heads(name))
    nothing = batch.rollout._replace(valid=jnp.zeros_like(batch.rollout.valid))
    after, metrics, _ = step(state, batch._replace(rollout=nothing))
    for part in ("policy", "policy_optimizer", "intrinsic", "intrinsic_optimizer"):
        equal(getattr(state, part), getattr(after, part))
    equal(
        getattr(state.intrinsic_state, "slow", None), getattr(after.intrinsic_state, "slow", None)
    )
    assert np.isfinite(list(metrics.values())).all()


def test_train_step_frame_between_two_reset_rows_is_never_read():
    """Of two reset rows in succession, no transition reads the frame between them."""
    kind = KINDS[2]
    for name in ("rnd", "snd_vic"):
        _, state, step = made(name, kind)
        batch = batch_for(kind, 1)
        valid = np.ones((STEPS, ENVS), bool)
        valid[3:5, 1] = False  # frames[4, 1] belongs to no valid row
        first = np.zeros((STEPS, ENVS), bool)
        first[5, 1] = True
        done = np.zeros((STEPS, ENVS), bool)
        done[2, 1] = True
        rollout = batch.rollout._replace(
            valid=jnp.asarray(valid), first=jnp.asarray(first), done=jnp.asarray(done)
        )
        clean = batch._replace(rollout=rollout)
        frames = rollout.frames.at[4, 1].set(jnp.nan)
        dirty = batch._replace(rollout=rollout._replace(frames=frames))
        equal(step(state, clean), step(state, dirty))


@pytest.mark.parametrize(
    ("name", "kind"),
    [("snd_std", KINDS[0]), ("ppo", KINDS[2])],
    ids=lambda x: getattr(x, "name", x),
)
def test_map_over_seeds_two_seeds_equal_each_seed_by_itself(name, kind):
    agent, _, _ = made(name, kind)
    seeds = [5, 6]
    states = make_init_states(agent)(seeds, example(kind))
    batches = [batch_for(kind, seed, heads(name)) for seed in range(2)]
    train_step = sndjax.make_train_step(agent)
    together = jax.jit(map_over_seeds(train_step, 2))(
        states, jax.tree.map(lambda *x: jnp.stack(x), *batches)
    )
    alone = jax.jit(map_over_seeds(train_step, 1))
    init = jax.jit(functools.partial(sndjax.init_train_state, agent))
    for i, batch in enumerate(batches):
        state = init(jax.random.key(seeds[i]), example(kind))
        equal(state.policy, jax.tree.map(lambda x: x[i], states.policy), rtol=1e-5, atol=1e-6)  # noqa: B023
        got = alone(*jax.tree.map(lambda x: x[None], (state, batch)))
        of_many = jax.tree.map(lambda x: x[i : i + 1], together)  # noqa: B023
        equal(got[1], of_many[1], rtol=2e-3, atol=1e-4)
        equal(got[0].policy, of_many[0].policy, rtol=1e-2, atol=3e-4)


def test_train_step_four_calls_are_traced_once():
    kind, traces = KINDS[2], []
    agent, state, _ = made("snd_vic", kind)
    train_step = sndjax.make_train_step(agent)

    @jax.jit
    def counted(state, batch):
        traces.append(1)
        return train_step(state, batch)

    for seed in range(4):
        state, _, _ = counted(state, batch_for(kind, seed))
    assert len(traces) == 1


@pytest.mark.parametrize(
    ("name", "kind"),
    [("rnd", KINDS[1]), ("snd_std", KINDS[0]), ("snd_vic", KINDS[2])],
    ids=lambda x: getattr(x, "name", x),
)
def test_update_intrinsic_module_ten_updates_lower_distillation_loss(name, kind):
    """Train the module on one rollout, and compare each copy with the target after ten updates.

    An SND target changes while it is copied, and its loss grows with its features. So the test
    is whether the last copy is nearer to the last target than the first copy.
    """
    agent, state, _ = made(name, kind)
    batch = batch_for(kind)
    step = jax.jit(lambda state, key: update_intrinsic_module(agent, state, batch, key))
    copies, losses = [state.intrinsic.signal], []
    for key in jax.random.split(jax.random.key(0), 10):
        learned, metrics = step(state, key)
        state = state._replace(**learned._asdict())
        copies.append(state.intrinsic.signal)
        losses.append(float(metrics["distillation_loss"]))
    rows = sndjax.gather_transitions(batch.rollout, jnp.arange(STEPS * ENVS))
    module = agent.intrinsic.module

    @jax.jit
    def against_the_last_target(copy):
        params = state.intrinsic._replace(signal=copy)
        return module.loss(params, state.intrinsic_state, rows, batch.rollout, jax.random.key(1))[
            1
        ]["distillation_loss"]

    values = [float(against_the_last_target(copy)) for copy in copies]
    assert values[-1] < values[0]
    if name == "rnd":  # its target is fixed, so the losses of the training itself must fall
        assert np.mean(losses[-3:]) < np.mean(losses[:3])


@pytest.mark.parametrize("signal", ["re3", "e3b"])
def test_train_step_re3_or_e3b_on_frozen_encoder_gives_bonus_without_training(signal):
    kind = KINDS[2]
    agent, _, _ = made("rnd", kind)
    module = sndjax.make_module("none", signal, kind.actions, kind.size)
    agent = agent._replace(intrinsic=agent.intrinsic._replace(module=module))
    state = jax.jit(functools.partial(sndjax.init_train_state, agent))(
        jax.random.key(0), example(kind)
    )
    assert not jax.tree.leaves(state.intrinsic)
    after, metrics, int_reward = jax.jit(sndjax.make_train_step(agent))(state, batch_for(kind))
    assert np.all(np.isfinite(int_reward))
    assert np.any(int_reward > 0)
    assert "module_grad_norm" not in metrics
    equal(state.intrinsic_state.encoder, after.intrinsic_state.encoder)


def test_compute_advantages_published_mask_inverts_done():
    """Compare with r - V within an episode and a bootstrap across its end, by hand."""
    from sndjax.ppo import compute_advantages

    no, yes = jnp.zeros((3, 1), bool), jnp.ones((3, 1), bool)
    done = no.at[1].set(True)
    rollout = sndjax.Rollout(jnp.zeros((4, 1, 1)), jnp.zeros((3, 1), int), no, done, yes)
    reward, value = jnp.array([[1.0], [2], [3]]), jnp.array([[10.0], [20], [30], [40]])[..., None]
    zero = jnp.zeros((3, 1))
    batch = sndjax.Experience(rollout, jnp.zeros((0, 1, 1)), reward, no, zero, value)
    hyper = ppo.Hyperparameters(gamma_ext=0.5, gae_lambda=1.0, ext_weight=1.0, published_mask=True)
    got, _ = compute_advantages(hyper, batch, zero)
    last = 3 - 30
    np.testing.assert_allclose(got[:, 0], [1 - 10, 2 + 0.5 * 30 - 20 + 0.5 * last, last])
    right, _ = compute_advantages(hyper._replace(published_mask=False), batch, zero)
    np.testing.assert_allclose(
        right[:, 0], [1 + 0.5 * 20 - 10 + 0.5 * (2 - 20), 2 - 20, 3 + 0.5 * 40 - 30]
    )


def test_act_samples_the_policy_and_executes_given_share_of_random_actions():
    kind = KINDS[2]
    agent, state, _ = made("snd_vic", kind)
    agent = agent._replace(random_action=0.25)
    actor = sndjax.Actor(state.policy, state.observations, state.key)
    act = jax.jit(functools.partial(sndjax.act, agent))
    frame = jnp.zeros((4000, *kind.shape))
    memory, first = sndjax.ActorMemory(frame[None]), jnp.ones(4000, bool)
    decision, _ = act(actor, memory, frame, first, 0)
    logits, value = agent.network.apply(state.policy, frame)
    wanted = jax.nn.log_softmax(logits)
    np.testing.assert_allclose(
        decision.log_prob, wanted[jnp.arange(4000), decision.action], rtol=1e-4
    )
    np.testing.assert_allclose(decision.value, value, rtol=1e-4, atol=1e-6)
    shares = np.bincount(decision.action, minlength=3) / 4000
    np.testing.assert_allclose(shares, np.exp(wanted[0]), atol=0.03)
    # A random action differs from the chosen one two times out of three.
    assert abs(np.mean(decision.action != decision.executed) - 0.25 * 2 / 3) < 0.03
    again, _ = act(actor, memory, frame, first, 0)
    np.testing.assert_array_equal(decision.action, again.action)
    other, _ = act(actor, memory, frame, first, 1)
    assert np.any(decision.action != other.action)


def test_train_step_unbounded_inputs_are_divided_by_std_of_earlier_iterations():
    kind = KINDS[2]
    agent, _, _ = made("rnd", kind)
    agent = agent._replace(unbounded=(True, False, True, False, False))
    state = sndjax.init_train_state(agent, jax.random.key(0), example(kind))
    step = jax.jit(sndjax.make_train_step(agent))
    batch = batch_for(kind)
    scaled, _, _ = step(state, batch)
    seen = np.asarray(batch.rollout.frames[:-1])[np.asarray(batch.rollout.valid)]
    np.testing.assert_allclose(scaled.observations.mean, seen.mean(0), rtol=1e-4, atol=1e-6)
    # The first iteration divides by 1; the second by the statistics of the first.
    _, metrics, _ = step(scaled, batch)
    divided = np.where([True, False, True, False, False], seen.std(0), 1).astype(np.float32)
    by_hand = batch._replace(
        rollout=batch.rollout._replace(frames=batch.rollout.frames / divided[None, None]),
        history=batch.history / divided[None, None],
    )
    plain = jax.jit(sndjax.make_train_step(agent._replace(unbounded=())))
    _, expected_metrics, _ = plain(scaled._replace(observations=state.observations), by_hand)
    equal(metrics, expected_metrics, rtol=1e-3, atol=1e-5)
