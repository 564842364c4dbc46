"""Rollouts of each library's environments against a plain loop, and what is refused."""

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.corridors import play_in_python

import sndjax
from experiments.benchmarks.random_agent import play_random
from experiments.config.compose import load_config
from experiments.environments.jax_environments import make_environment
from experiments.environments.pools import make_pool
from experiments.system.errors import ConfigError
from sndjax.jax_environment import environment_keys

TASK = Path(__file__).parents[2] / "helpers" / "jax_task.py"
OWN = ["env=jax", f"env.id={TASK}:make"]
ENVS = 3
# suite, task with options that make episodes short, rows
TASKS = [
    (["env=gymnax", "env.id=DeepSea-bsuite", "env.options.size=4"], 16),
    (["env=gymnax", "env.id=MountainCar-v0", "env.options.max_steps_in_episode=7"], 20),
    (["env=gymnax", "env.id=Breakout-MinAtar"], 40),
    (["env=xminigrid", "env.id=MiniGrid-DoorKey-5x5", "env.options.max_steps=9"], 24),
    (["env=craftax", "env.id=Craftax-Classic-Symbolic-v1", "env.options.max_timesteps=5"], 14),
    (["env=navix", "env.id=Navix-DoorKey-5x5-v0", "env.options.max_steps=9"], 24),
    ([*OWN, "env.options.limit=9"], 30),
]
NAMES = [arguments[1].rpartition("/")[2] for arguments, _ in TASKS]


def config_of(*arguments):
    return load_config([*arguments, "algo=ppo"])


@pytest.fixture(autouse=True)
def lenient():
    """Let the libraries broadcast as they do for their own users."""
    with jax.numpy_rank_promotion("allow"):
        yield


def needs(arguments):
    """Skip the test if the package of the suite is not installed."""
    suite = arguments[0].removeprefix("env=")
    if suite != "jax" and importlib.util.find_spec(suite) is None:
        pytest.skip(f"{suite} is not installed")


@pytest.mark.parametrize(("arguments", "steps"), TASKS, ids=NAMES)
def test_collect_library_rollout_equals_a_loop_over_single_environments(arguments, steps):
    needs(arguments)
    env = make_environment(config_of(*arguments).env)
    start = jax.random.key(3)
    live = jax.jit(lambda: sndjax.init_environments(env, start, ENVS))()
    key = jax.random.key(5)
    keys = [environment_keys(jax.random.fold_in(key, t), ENVS) for t in range(steps)]
    rng = np.random.default_rng(0)
    actions = rng.integers(0, env.num_actions, (steps, ENVS)).astype(np.int32)

    @jax.jit
    def rows(live):
        def step(live, inputs):
            action, t = inputs
            key_t = jax.random.fold_in(key, t)
            row, after = sndjax.step_environments(env, live, action, key_t)
            return after, (live.frame, live.first, row)

        live, columns = jax.lax.scan(step, live, (jnp.asarray(actions), jnp.arange(steps)))
        return live, columns

    after, (frames, first, row) = rows(live)
    wanted_frames, wanted = play_in_python(
        env, environment_keys(start, ENVS), actions, jnp.stack(keys)
    )
    frames = np.concatenate([frames, after.frame[None]])
    np.testing.assert_allclose(frames, wanted_frames, atol=1e-6)  # Craftax computes with floats
    np.testing.assert_array_equal(first, wanted["first"].astype(bool))
    for name in ("done", "truncated", "valid"):
        np.testing.assert_array_equal(getattr(row, name), wanted[name].astype(bool), name)
    np.testing.assert_allclose(row.reward, wanted["reward"], atol=1e-6)
    assert (~row.valid).sum() >= ENVS  # resets


@pytest.mark.parametrize(("arguments", "steps"), TASKS, ids=NAMES)
def test_JaxPool_follows_the_protocol_of_pools(arguments, steps):
    needs(arguments)
    pool = make_pool(config_of(*arguments).env, [0, 1], ENVS)
    frame = pool.reset()
    assert frame.shape == (2, ENVS, *pool.shape)
    assert frame.dtype == pool.dtype
    assert np.abs(frame).max() <= 1 or any(pool.unbounded)
    before, rng = np.zeros((2, ENVS), bool), np.random.default_rng(0)
    for _ in range(steps):
        step = pool.step(rng.integers(0, pool.num_actions, (2, ENVS)))
        np.testing.assert_array_equal(step.valid, ~before)
        assert not step.reward[before].any()
        assert not step.done[before].any()
        before = step.done
    assert pool.environment is not None


def test_random_agent_finds_the_treasure_of_deep_sea_with_probability_two_to_the_minus_n():
    needs(["env=gymnax"])
    sea = ["env=gymnax", "env.id=DeepSea-bsuite", "env.options.size=5", "num_envs=128"]
    returns, lengths, _ = play_random(config_of(*sea, "total_steps=40000"), keep=1)
    assert (lengths == 5).all()
    assert len(returns) > 6000
    found, chance = (returns > 0.5).sum(), 2**-5
    deviation = np.sqrt(len(returns) * chance * (1 - chance))
    assert abs(found - len(returns) * chance) < 4 * deviation


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["env=gymnax"], "env=gymnax needs a task, such as env.id=DeepSea-bsuite"),
        (["env=gymnax", "env.id=DeepSee"], "did you mean DeepSea-bsuite"),
        (["env=gymnax", "env.id=Pendulum-v1"], "its actions are Box of shape"),
        (
            ["env=gymnax", "env.id=DeepSea-bsuite", "env.options.sise=6"],
            "gymnax cannot make DeepSea-bsuite: .*sise",
        ),
        (["env=xminigrid", "env.id=MiniGrid-DoorKey"], "did you mean MiniGrid-DoorKey"),
        (["env=craftax", "env.id=Craftax"], "unknown craftax task 'Craftax'"),
        (["env=jax", "env.id=nothing.py:make"], "there is no file nothing.py"),
        (["env=jax", "env.id=CartPole-v1"], "write FILE.py:FUNCTION"),
        ([*OWN, "env.options.sells=4"], "TypeError.*sells"),
        (["env=jax", f"env.id={TASK}:jnp"], "has no function jnp"),
        (["env=jax", f"env.id={TASK}:sndjax"], "has no function sndjax"),
        (["env=MountainCar", "env.suite=craftax"], "env=MountainCar has a fixed task"),
        (["env=gymnax", "env.suite=envpool", "env.id=CartPole-v1"], "env=gymnax has a fixed"),
    ],
)
def test_make_environment_bad_input_is_one_line(arguments, message):
    needs([arguments[0]] if arguments[0] != "env=MountainCar" else ["env=jax"])
    with pytest.raises(ConfigError, match=message) as caught:
        make_pool(config_of(*arguments).env, [0], 1)
    assert "\n" not in str(caught.value)


BROKEN = """
import jax.numpy as jnp
import sndjax

def number():
    return 3

def other_shape():
    reset = lambda key: (jnp.zeros(2), jnp.zeros(2))
    step = lambda key, state, action: (state, jnp.zeros(3), 0.0, True, False)
    return sndjax.JaxEnvironment(reset, step, 2)

def parts():
    reset = lambda key: (jnp.zeros(2), {"a": jnp.zeros(2)})
    step = lambda key, state, action: (state, {"a": jnp.zeros(2)}, 0.0, True, False)
    return sndjax.JaxEnvironment(reset, step, 2)

def fails():
    return sndjax.JaxEnvironment(lambda key: 1 / 0, lambda *args: None, 2)
"""


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("number", r"number\(...\) must return an sndjax.JaxEnvironment, not int"),
        ("other_shape", r"observation is float32\[2\] after reset and float32\[3\] after step"),
        ("parts", "observations are not one array"),
        ("fails", "division by zero"),
    ],
)
def test_make_environment_of_the_user_that_is_broken_is_one_line(name, message, tmp_path):
    (tmp_path / "broken.py").write_text(BROKEN)
    with pytest.raises(ConfigError, match=message):
        make_pool(config_of("env=jax", f"env.id={tmp_path}/broken.py:{name}").env, [0], 1)


@pytest.mark.parametrize(
    ("suite", "words"),
    [
        ("navix", r"pip install 'sndjax\[jax-envs\]'; navix 4 needs Python 3.12"),
        ("gymnax", "needs the package gymnax"),
        ("craftax", "needs the package craftax"),
        ("xminigrid", "needs the package xminigrid"),
    ],
)
def test_load_config_missing_package_says_what_to_install(suite, words, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=words):
        config_of(f"env={suite}", "env.id=x")


def test_deep_sea_place_is_the_cell_that_is_seen():
    needs(["env=gymnax"])
    env = make_environment(config_of(*TASKS[0][0]).env)
    key = jax.random.key(0)
    state, seen = env.reset(key)
    for t in range(4):
        assert int(env.place(state)) == int(jnp.argmax(seen.ravel()))
        state, seen, _, ended, _ = env.step(key, state, jnp.int32(t % 2))
    assert ended
    assert 4 * 4 <= int(env.place(state)) < env.num_places
