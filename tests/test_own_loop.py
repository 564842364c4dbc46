"""Tests of `sndjax.bonus`: what a loop of one's own gets, against loops that are written out."""

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import optax
import pytest
from helpers.processes import ROOT
from helpers.rollouts import KINDS, episodes, frames

import sndjax
from sndjax import bonus, from_autoreset, make_module
from sndjax.architectures import size_for
from sndjax.bonus_record import BonusChanges
from sndjax.grid import SIGNALS
from sndjax.rollout import gather_rows, minibatch_rows

pytestmark = pytest.mark.usefixtures("quick_compilation")
A, D, T, N = 3, 5, 8, 4
DEFAULTS = {"minibatch_size": 8, "reward_scale": "none", "eta": 0.5}
MEMORIES = {"e3b", "ngu", "noveld"}


def steps(seed=0, rows=T, envs=N, shape=(D,)):
    """Return obs, action, next_obs, done of random transitions."""
    rng = np.random.default_rng(seed)
    obs, after = (frames(rng, shape, rows, envs) for _ in range(2))
    action = rng.integers(0, A, (rows, envs)).astype(np.int32)
    return tuple(map(jnp.asarray, (obs, action, after, rng.random((rows, envs)) < 0.2)))


@pytest.fixture
def unchecked():
    """Do not check signatures at run time: what a caller passes in is ours to refuse."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def cell(signal, objective="inverse_dynamics"):
    return make_module(objective, signal, A, KINDS[2].size)


def made(name="rnd", **settings):
    """Return a bonus and its state; minibatches of 8 rows."""
    own = bonus(name, A, jnp.zeros((N, D)), **(DEFAULTS | settings))
    state = own.init(jax.random.key(0), jnp.zeros((N, D)))
    jitted = lambda step: jax.jit(step, static_argnames="train")
    return own._replace(step=jitted(own.step), step_batch=jitted(own.step_batch)), state


def test_bonus_step_equals_a_loop_that_is_written_out():
    """Standardize with NumPy, read, scale, then Adam over rows in order, one minibatch a time."""
    own, state = made("icm", standardize=True)
    obs, action, after, done = steps()
    reward, new, metrics = own.step(state, obs, action, after, done)

    flat = np.asarray(obs, np.float64).reshape(-1, D)
    squeeze = lambda x: np.clip((np.asarray(x) - flat.mean(0)) / flat.std(0), -5, 5)
    params, _, module_state = state.trained
    woven = from_autoreset(*map(jnp.float32, (squeeze(obs), squeeze(after))), action, done)
    signal, module_state = own.module.reward(params, module_state, woven, jax.random.key(1))
    wanted = np.clip(0.5 * np.asarray(signal[::2], np.float64), 0, 1)
    np.testing.assert_allclose(reward, wanted, rtol=1e-5)
    assert np.ptp(wanted) > 0
    adam = optax.adam(1e-4)
    moments, losses = adam.init(params), []
    for t in range(0, T, 2):  # 8 rows are two steps of four environments
        rows = jnp.array([2 * s * N + n for s in (t, t + 1) for n in range(N)])
        batch = sndjax.gather_transitions(woven, rows)
        (value, _), slope = jax.value_and_grad(own.module.loss, has_aux=True)(
            params, module_state, batch, woven, jax.random.key(2)
        )
        change, moments = adam.update(slope, moments)
        params = optax.apply_updates(params, change)
        losses.append(value)
    for mine, theirs in zip(
        jax.tree.leaves(new.trained.intrinsic), jax.tree.leaves(params), strict=True
    ):
        np.testing.assert_allclose(mine, theirs, rtol=1e-4, atol=1e-6)
    assert float(metrics["module_loss"]) == pytest.approx(float(np.mean(losses)), rel=1e-4)


def test_bonus_step_running_std_divides_by_the_deviation_of_discounted_sums():
    own, state = made(reward_scale="running_std", eta=2.0, discount=0.9, learning_rate=0.0)
    plain, other = made(reward_scale="none", eta=1e-3, learning_rate=0.0)
    sums, total = [], np.zeros(N)
    for seed in range(3):
        reward, state, _ = own.step(state, *steps(seed))
        signal, other, _ = plain.step(other, *steps(seed))  # small enough to be clipped nowhere
        signal = np.asarray(signal, np.float64) * 1e3
        for row in signal:
            total = 0.9 * total + row
            sums.append(total)
        np.testing.assert_allclose(reward, 2 * signal / np.std(sums), rtol=1e-4)


@pytest.mark.parametrize("signal", sorted(set(SIGNALS) - MEMORIES))
def test_bonus_step_reward_of_a_terminal_step_is_that_of_any_other(signal):
    """The reset in the step does not enter: flags change nothing without episode memory."""
    own, state = made(cell(signal))
    obs, action, after, done = steps()
    ended, _, _ = own.step(state, obs, action, after, done)
    going, _, _ = own.step(state, obs, action, after, jnp.zeros_like(done))
    np.testing.assert_array_equal(ended, going)
    assert (np.asarray(ended)[np.asarray(done)] != 0).any()


@pytest.mark.parametrize("signal", ["e3b", "noveld", "prediction", "simhash"])
def test_bonus_step_next_step_resets_give_the_flags_of_the_rollout(signal):
    """Two rollouts of rows with next-step resets, against their true flags."""
    rng = np.random.default_rng(3)
    first, done, valid = episodes(rng, 2 * T, N)
    for n in range(N):  # `episodes` may begin anywhere; a bonus begins where environments do
        first[:, n], done[:, n], valid[:, n] = restart(rng)
    obs = jnp.asarray(frames(rng, (D,), 2 * T + 1, N))
    action = jnp.asarray(rng.integers(0, A, (2 * T, N)).astype(np.int32))
    settings = {"learning_rate": 0.0, "standardize": False, "eta": 1e-3}
    own, state = made(cell(signal), reset="next_step", **settings)
    _, _, other = state.trained
    for half in (slice(0, T), slice(T, 2 * T)):
        got, state, _ = own.step(
            state, obs[half], action[half], done=jnp.asarray(done[half]), last_obs=obs[half.stop]
        )
        rollout = sndjax.Rollout(
            obs[half.start : half.stop + 1],
            action[half],
            *(jnp.asarray(x[half]) for x in (first, done, valid)),
        )
        wanted, other = own.module.reward(state.trained.intrinsic, other, rollout, state.key)
        assert (np.asarray(got)[~valid[half]] == 0).all()
        np.testing.assert_allclose(got, 1e-3 * np.asarray(wanted), rtol=1e-6)
    jax.tree.map(np.testing.assert_array_equal, state.trained.intrinsic_state, other)


def restart(rng):
    """Return first, done, valid of one environment that opens an episode at row 0."""
    first, done, valid = (np.zeros(2 * T, bool), np.zeros(2 * T, bool), np.ones(2 * T, bool))
    opening = True
    t = 0
    while t < 2 * T:
        first[t], done[t] = opening, rng.random() < 0.3
        opening = done[t]
        t += 1
        if opening and t < 2 * T:
            valid[t] = False
            t += 1
    return first, done, valid


@pytest.mark.parametrize("signal", SIGNALS)
def test_bonus_step_reads_the_next_state_where_the_manual_says_so(signal):
    """docs/layout.md has the table: change s_t+1 of the last row alone, and see what moves."""
    own, state = made(cell(signal), standardize=False, learning_rate=0.0, eta=1e-3)
    data = steps(rows=16), steps(seed=1, rows=16)
    obs, action, after, _ = data[0]
    no = jnp.zeros((16, N), bool)
    before, _, _ = own.step(state, obs, action, after, no)
    moved, _, _ = own.step(state, obs, action, after.at[-1].set(data[1][2][-1]), no)
    page = (ROOT / "docs" / "layout.md").read_text()
    (row,) = [
        line for line in page.splitlines() if line.startswith("| `") and f"`{signal}`" in line
    ]
    assert (np.asarray(before[-1]) != moved[-1]).any() == ("s_t+1" in row)


def test_bonus_step_without_last_observations_gives_terminal_steps_nothing():
    own, state = made("icm")
    obs, action, _, done = steps()
    reward, state, _ = own.step(state, obs, action, done=done, last_obs=obs[0])
    assert (reward[done] == 0).all()
    assert (reward[~done] > 0).all()
    np.testing.assert_array_equal(state.first, done[-1])


def test_bonus_step_carries_the_flags_of_episodes_between_rollouts():
    """One rollout of 2T steps, and two of T: NovelD pays the same first visits, of three states."""
    settings = {"learning_rate": 0.0, "standardize": False, "reward_scale": "none", "eta": 1e-3}
    module = make_module(
        "none", "noveld", A, KINDS[2].size, signal_options={"centre": False, "alpha": 0.0}
    )
    own, state = made(module, **settings)
    obs, action, after, done = steps(rows=2 * T)
    obs, after = (
        jnp.round(jnp.clip(x[..., :1], -1, 1)) * jnp.ones((1, 1, D)) for x in (obs, after)
    )
    wanted, _, _ = own.step(state, obs, action, after, done)
    parts, forgetful = [], []
    for half in (slice(0, T), slice(T, 2 * T)):
        data = (obs[half], action[half], after[half], done[half])
        forgot, _, _ = own.step(state._replace(first=jnp.ones(N, bool)), *data)
        part, state, _ = own.step(state, *data)
        parts.append(part)
        forgetful.append(forgot)
    np.testing.assert_allclose(np.concatenate(parts), wanted, rtol=1e-6)
    assert ((np.concatenate(forgetful) > 0) != (wanted > 0)).any()


@pytest.mark.parametrize("signal", sorted(SIGNALS))
def test_bonus_step_batch_refuses_signals_with_episode_memory_by_name(signal):
    own, state = made(cell(signal))
    obs, action, after, done = (x[0] for x in steps(envs=7))
    if signal in MEMORIES:
        with pytest.raises(ValueError, match=rf"signal={signal}\(.*remembers the running episode"):
            own.step_batch(state, obs, action, after)
        return
    reward, new, _ = own.step_batch(state, obs, action, after, valid=1.0 - done)
    assert reward.shape == (7,)
    np.testing.assert_array_equal(np.asarray(reward) != 0, ~done)
    shapes = lambda tree: [leaf.shape for leaf in jax.tree.leaves(tree)]
    assert shapes(new) == shapes(state)


def test_bonus_step_batch_scales_by_the_deviation_of_the_signal_itself():
    own, state = made(reward_scale="running_std", eta=1.0, learning_rate=0.0)
    plain, other = made(reward_scale="none", eta=1e-3, learning_rate=0.0)
    seen = []
    for seed in range(3):
        obs, action, after, _ = (x[0] for x in steps(seed, envs=16))
        reward, state, _ = own.step_batch(state, obs, action, after)
        signal, other, _ = plain.step_batch(other, obs, action, after)
        signal = np.asarray(signal, np.float64) * 1e3
        seen.append(signal)
        np.testing.assert_allclose(reward, signal / np.std(seen), rtol=1e-4)


def test_bonus_step_train_false_moves_no_weight():
    own, state = made("snd_vic")
    reward, after, metrics = own.step(state, *steps(), train=False)
    jax.tree.map(np.testing.assert_array_equal, state.trained.intrinsic, after.trained.intrinsic)
    assert "module_loss" not in metrics
    same, _, _ = own.step(state, *steps())
    np.testing.assert_array_equal(reward, same)
    assert after.observations.samples == T * N


def test_bonus_step_epochs_take_so_many_optimizer_steps():
    own, state = made("rnd", epochs=3, shuffle=True)
    _, after, _ = own.step(state, *steps())
    (count,) = {int(x) for x in jax.tree.leaves(after.trained.intrinsic_optimizer) if x.ndim == 0}
    assert count == 3 * T * N // 8


def test_bonus_step_under_jit_scan_and_vmap_equals_the_call_by_itself():
    own, _ = made("rnd", shuffle=True)
    keys = jax.random.split(jax.random.key(5), 2)
    data = [jnp.stack(pair) for pair in zip(steps(1), steps(2), strict=True)]

    def run(key):
        def one(state, part):
            reward, state, _ = own.step(state, *part)
            return state, reward

        return jax.lax.scan(one, own.init(key, jnp.zeros((N, D))), tuple(data))[1]

    together = jax.jit(jax.vmap(run))(keys)
    for key, rewards in zip(keys, together, strict=True):
        state = own.init(key, jnp.zeros((N, D)))
        for part, wanted in zip(zip(*data, strict=True), rewards, strict=True):
            reward, state, _ = own.step(state, *part)
            np.testing.assert_allclose(reward, wanted, rtol=2e-4, atol=1e-6)


def test_bonus_step_unknown_actions_inside_jit_are_counted():
    own, state = made("rnd")
    obs, action, after, done = steps()
    _, _, metrics = jax.jit(own.step)(state, obs, action.at[0, 0].set(A), after, done)
    assert metrics["unknown_actions"] == 1


def test_bonus_settings_of_presets_and_of_signals_without_a_published_scale():
    vectors, images = jnp.zeros((N, D)), jnp.zeros((N, 64, 64, 3), jnp.uint8)
    assert bonus("rnd", A, images).settings[:5] == (0.5, "none", 0.99, 1e-4, 512)
    assert not bonus("rnd", A, images).settings.standardize
    assert bonus("none+noveld", A, images).settings[:2] == (1.0, "running_std")
    # The published unit is that of the published networks on pixels.
    assert bonus("rnd", A, vectors).settings[:5] == (1.0, "running_std", 0.99, 1e-4, 512)
    assert bonus("rnd", A, vectors).settings.standardize
    assert bonus("rnd", A, images, preset="small").settings.reward_scale == "running_std"
    assert bonus("rnd", A, vectors, eta=3.0).settings.eta == 3.0
    assert set(BonusChanges.__annotations__) == set(sndjax.BonusSettings._fields)


@pytest.mark.parametrize("name", ["rnd", "qrnd", "snd_v", "snd_vic", "snd_byol", "icm", "sp_vic"])
def test_bonus_of_a_name_distinguishes_states_and_its_state_can_be_donated(name):
    example = jnp.zeros((N, D))
    own = bonus(name, A, example)
    state = own.init(jax.random.key(0), example)
    step = jax.jit(own.step, donate_argnums=0)
    kinds = lambda tree: [(x.shape, x.dtype, x.weak_type) for x in jax.tree.leaves(tree)]
    made = jax.eval_shape(own.init, jax.random.key(0), example)
    assert kinds(jax.eval_shape(own.step, state, *steps())[1]) == kinds(made)
    reward, _, _ = step(state, *steps())
    assert np.std(reward) > 1e-3 * np.abs(reward).mean()


@pytest.mark.parametrize("rows", [(1, 1), (5, 3), (16, 8), (7, 9)])
@pytest.mark.parametrize("shuffle", [False, True])
def test_minibatch_rows_hold_every_row_once_in_minibatches_of_equal_size(rows, shuffle):
    time, envs = rows
    index = minibatch_rows(jax.random.key(0), time, envs, 16, shuffle, stride=2)
    there = np.asarray(index) < 2 * time * envs
    wanted = [2 * t * envs + n for t in range(time) for n in range(envs)]
    found = np.asarray(index)[there]
    assert sorted(found) == wanted
    assert np.ptp(there.sum(1)) <= 1
    assert shuffle or found.tolist() == wanted


def test_size_for_follows_the_shape_of_a_frame():
    assert size_for((84, 84, 1)) == sndjax.ATARI
    assert size_for((64, 64, 3)) == sndjax.PROCGEN
    assert size_for((64, 64, 3), "small") == sndjax.SMALL
    for shape in [(2,), (7, 7, 3), (8, 8)]:
        assert size_for(shape) == sndjax.VECTOR


def test_bonus_on_images_and_small_grids_learns():
    for shape, dtype in [((64, 64, 3), np.uint8), ((10, 10, 4), bool), ((8, 8), np.float32)]:
        obs = jnp.asarray(np.random.default_rng(0).integers(0, 2, (2, 2, *shape)).astype(dtype))
        own = bonus("snd_vic", A, obs[0], preset="small")
        state = own.init(jax.random.key(0), obs[0])
        no = jnp.zeros((2, 2), bool)
        reward, _, metrics = jax.jit(own.step)(state, obs, no.astype(int), obs, no)
        assert np.isfinite(reward).all()
        assert metrics["module_grad_norm"] > 0


def call(own, state, **changed):
    obs, action, after, done = steps()
    given = {"obs": obs, "action": action, "next_obs": after, "done": done} | changed
    return own.step(state, **given)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"obs": jnp.zeros((N, D))}, r"obs has shape \(4, 5\); it must be \[T, N, 5\]; for one"),
        ({"obs": jnp.zeros((T, N, 6))}, r"must be \[T, N, 5\], since the example's"),
        ({"obs": jnp.zeros((T, N, D), int)}, "obs is int.., and the example is float32"),
        ({"obs": {"x": 1}}, r"obs is a dict; it must be an array \[T, N, 5\]"),
        ({"obs": jnp.zeros((N, T, D))}, r"obs has 8 environments, and init got 4; .*time first"),
        ({"next_obs": None}, r"give either next_obs \[T, N"),
        ({"last_obs": jnp.zeros((N, D))}, r"give either next_obs \[T, N"),
        ({"next_obs": jnp.zeros((T - 1, N, D))}, r"next_obs has \(7, 4\) rows, and obs has \(8, 4"),
        ({"action": jnp.zeros((T, N))}, "action is float32; actions are integers, 0 to 2"),
        ({"action": jnp.full((T, N), 3)}, "action 3 does not exist: there are 3, 0 to 2"),
        ({"action": jnp.zeros((T, N, 1), int)}, r"action has \(8, 4, 1\) rows"),
        ({"done": None}, r"done is None; it must be an array of shape \(8, 4\)"),
        ({"action": jnp.zeros((T, N, 2))}, "vectors of continuous actions are not supported"),
    ],
)  # fmt: skip
def test_bonus_step_says_what_is_wrong_with_an_array(changed, words, unchecked):
    own = bonus("rnd", A, jnp.zeros((N, D)))
    state = own.init(jax.random.key(0), jnp.zeros((N, D)))
    with pytest.raises(ValueError, match=words):
        call(own, state, **changed)


def test_bonus_takes_double_precision_of_numpy(unchecked):
    """Outside of x64 mode jax makes float32 of it: the example and the arrays still agree."""
    example = np.zeros((N, D))
    own = bonus("rnd", A, example)
    data = [np.asarray(x, np.float64 if x.ndim == 3 else None) for x in steps()]
    reward, _, _ = jax.jit(own.step)(own.init(jax.random.key(0), jnp.asarray(example)), *data)
    assert reward.dtype == np.float32
    same, _, _ = own.step(own.init(jax.random.key(0), example), *data)
    np.testing.assert_allclose(same, reward, rtol=1e-5)


def test_bonus_step_counts_resets_that_are_given_as_next_observations():
    own, state = made("rnd")
    obs, action, after, done = steps()
    _, _, metrics = own.step(state, obs, action, after, done)
    assert metrics["resets_as_next_obs"] == 0
    after = after.at[:-1].set(obs[1:])  # what a self-resetting loop returns
    _, _, metrics = own.step(state, obs, action, after, done)
    assert metrics["resets_as_next_obs"] == done[:-1].sum() > 0


def test_gather_rows_of_a_padded_minibatch_are_valid_where_they_exist():
    """Also where the numbers of rows are known, as under `jax.disable_jit`."""
    obs, action, after, done = steps(rows=2)
    index = minibatch_rows(jax.random.key(0), 2, N, 3, shuffle=False, stride=2)
    rollout = from_autoreset(obs, after, action, done)
    valid = [gather_rows(rollout, rows).valid for rows in index]
    np.testing.assert_array_equal(valid, np.asarray(index) < 3 * N)
    assert np.sum(valid) == 2 * N


def test_bonus_step_takes_numbers_for_done():
    own, state = made("icm")
    obs, action, after, done = steps()
    for flags in (done, done.astype(jnp.float32)):  # brax has floats
        _, after_step, _ = own.step(state, obs, action, after, flags)
        np.testing.assert_array_equal(after_step.first, done[-1])


@pytest.mark.parametrize(
    ("example", "words"),
    [
        (jnp.zeros(5), r"example has shape \(5,\).* write obs\[None\]"),
        (jnp.zeros((N, 3, 64, 64)), "have their channels first; they must be last"),
        (jnp.zeros((N, 20, 64, 64)), "have their channels first; they must be last"),
        (jnp.zeros((N, 4, 84, 84, 1)), r"more axes than an image \[H, W, C\]; join"),
        (jnp.zeros((N, 84, 84)), r"images without an axis of channels; write obs\[..., None\]"),
        ({"position": 1}, "example is a dict; it must be one array"),
    ],
)
def test_bonus_says_what_is_wrong_with_an_example(example, words, unchecked):
    with pytest.raises(ValueError, match=words):
        bonus("rnd", A, example)


def test_bonus_unknown_names_and_settings_are_answered_with_those_there_are(unchecked):
    example = jnp.zeros((N, D))
    with pytest.raises(ValueError, match="no intrinsic module is called 'snd'; there is rnd"):
        bonus("snd", A, example)
    with pytest.raises(ValueError, match="preset='tiny'; it is one of thesis, small"):
        bonus("rnd", A, example, preset="tiny")
    with pytest.raises(ValueError, match="no setting lr; it has eta"):
        bonus("rnd", A, example, lr=1.0)
    with pytest.raises(ValueError, match="reset='nextstep'; it is one of same_step, next_step"):
        bonus("rnd", A, example, reset="nextstep")
    with pytest.raises(
        ValueError, match="reward_scale='std'; it is one of none, unclipped, running_std"
    ):
        bonus("rnd", A, example, reward_scale="std")
    with pytest.raises(ValueError, match="epochs=0; it must be 1 or more"):
        bonus("rnd", A, example, epochs=0)
    with pytest.raises(ValueError, match="num_actions=0; it must be 1 or more"):
        bonus("rnd", 0, example)
    with pytest.raises(ValueError, match="gradient='no'; it is one of symmetric, detached"):
        bonus("icm", A, example, module_options={"signal_options": {"gradient": "no"}})
    with pytest.raises(ValueError, match="unknown signal 'novel'; there is"):
        bonus("none+novel", A, example)
    with pytest.raises(ValueError, match="made already"):
        bonus(cell("re3"), A, example, module_options={"preprocess": "mean"})
