"""Tests of the examples, which run as their docstrings describe."""

import importlib.util
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sndjax
from experiments.run import main

EXAMPLES = Path(__file__).parents[1] / "examples"
SMALL = ["rollout_length=32", "ppo.minibatch_size=64", "algo.minibatch_size=64"]


def load(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def metrics(path):
    return [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]


def test_example_purejaxrl_style_has_a_bonus_in_eleven_lines():
    """What it learns is tested where the library is installed alone, in test_wheel.py."""
    text = (EXAMPLES / "purejaxrl_style.py").read_text()
    assert sum(line.endswith("# +") for line in text.splitlines()) == 11
    assert len((EXAMPLES / "my_bonus.py").read_text().splitlines()) < 40


def test_example_replay_rewards_batches_of_a_replay(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    replay = load("replay")
    replay.STEPS, replay.CAPACITY = 12, 8  # the replay is overwritten
    visits = jax.jit(lambda: replay.train("rnd", 0.1, 0))()
    assert visits.sum() == 12 * replay.ENVS
    assert visits.shape == (replay.MAZE.size,)


def test_my_bonus_on_command_line_learns_and_resume_needs_its_path(tmp_path, monkeypatch):
    monkeypatch.chdir(EXAMPLES.parent)
    bonus = "algo.module=examples/my_bonus.py:my_bonus"
    arguments = [
        "env=MountainCar",
        bonus,
        *SMALL,
        "num_envs=8",
        "total_steps=5120",
        f"run_dir={tmp_path / 'r'}",
    ]
    assert main(arguments) == 0
    entries = metrics(tmp_path / "r")
    assert entries[-1]["info_nce"] < entries[0]["info_nce"]
    assert all(entry["int_reward_mean"] > 0 for entry in entries)
    # Resuming the run needs the path of the code again.
    assert main([f"resume={tmp_path / 'r'}"]) == 2
    assert main([f"resume={tmp_path / 'r'}", bonus]) == 0


@pytest.mark.parametrize("image", [False, True])
def test_own_environment_vector_or_image_trains_with_right_counts(image, tmp_path, monkeypatch):
    monkeypatch.chdir(EXAMPLES.parent)
    arguments = [
        "env=gymnasium", "env.id=examples.own_environment:Corridor-v0", "algo=snd_vic", *SMALL,
        "num_envs=2", f"env.options.image={image}", f"run_dir={tmp_path / 'r'}", "total_steps=128",
        "ppo.epochs=1",
    ]  # fmt: skip
    assert main(arguments) == 0
    entries = metrics(tmp_path / "r")
    assert [entry["step"] for entry in entries] == [64, 128]
    assert entries[-1]["transitions"] == 128 - 2  # each corridor is reset once, after 60 steps
    assert entries[-1]["episodes"] == 2


def test_pure_jax_environment_equals_gymnax_deep_sea():
    gymnax = pytest.importorskip("gymnax")
    sea = load("pure_jax")
    env, params = gymnax.make("DeepSea-bsuite", size=sea.SIZE)
    rng = np.random.default_rng(0)
    _, wanted = env.reset_env(jax.random.key(0), params)
    state, _ = sea.reset(jax.random.key(0))
    for t in range(sea.SIZE):
        # What "right" is differs: each follows its own mapping of actions.
        right = rng.random() < 0.8
        own = sea.LEFT_OR_RIGHT[tuple(state)]
        action = own if right else ~own
        other = wanted.action_mapping[wanted.row, wanted.column]
        frame, wanted, reward, end, _ = env.step_env(
            jax.random.key(t), wanted, other if right else 1 - other, params
        )
        state, look, mine, ended, _ = sea.step(None, state, action)
        np.testing.assert_array_equal(look, frame.ravel())
        assert float(mine) == pytest.approx(float(reward), abs=1e-7)
        assert bool(ended) == bool(end)
    assert bool(ended)


def test_pure_jax_trains_all_seeds_in_one_function():
    sea = load("pure_jax")
    sea.ITERATIONS = 2
    for bonus in (None, sndjax.rnd):
        found = jax.jit(jax.vmap(lambda seed, bonus=bonus: sea.train(bonus, seed)))(jnp.arange(2))
        assert found.shape == (2, 2)
        assert (found >= 0).all()
    assert len((EXAMPLES / "pure_jax.py").read_text().splitlines()) < 70
