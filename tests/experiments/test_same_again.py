"""Check that a repeated command and a resumed update give the same bits."""

import json
import subprocess
import sys

import numpy as np
import pytest
from helpers.processes import CAR, lines, start, tree_of

VENTURE = ["env=Venture", "algo=snd_std", "num_envs=4", "rollout_length=32"]
VENTURE += ["ppo.minibatch_size=64", "algo.minibatch_size=64"]


@pytest.mark.parametrize(
    ("arguments", "iterations"),
    [
        ([*CAR, "algo=snd_vic", "total_steps=4096"], 32),
        pytest.param(
            [*CAR, "algo=snd_vic", "total_steps=4096", "overlap=1"],
            32,
            marks=pytest.mark.exhaustive,
        ),
        pytest.param([*VENTURE, "total_steps=256"], 2, marks=pytest.mark.survival),
    ],
)
def test_run_same_command_at_once_and_repeated_gives_the_same_bits(arguments, iterations, tmp_path):
    arguments = [*arguments, "num_seeds=2"]
    begin = lambda name: start([*arguments, f"run_dir={tmp_path / name}"], tmp_path)
    for process in [begin("a"), begin("b")]:
        with process:
            _, err = process.communicate(timeout=300)
        assert process.returncode == 0, err
    again = [f"repeat={tmp_path / 'a' / 'config.yaml'}", f"run_dir={tmp_path / 'c'}"]
    with start(again, tmp_path) as process:
        _, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    (at, first), entries = tree_of(tmp_path / "a"), lines(tmp_path / "a")
    assert at == iterations
    assert len(entries) == 2 * iterations
    for name in "bc":
        path = tmp_path / name
        assert lines(path) == entries
        episodes = (path / "episodes.csv").read_bytes()
        assert episodes == (tmp_path / "a" / "episodes.csv").read_bytes()
        iteration, other = tree_of(path)
        assert iteration == at
        for one, two in zip(first, other, strict=True):
            np.testing.assert_array_equal(one, two)
    summary = json.loads((tmp_path / "a" / "summary.json").read_text())
    assert [seed["seed"] for seed in summary["seeds"]] == [0, 1]
    assert summary["seeds"][0]["episodes"] > 0 or iterations == 2  # no Atari episode ends in two


def test_train_step_resumed_on_a_recorded_rollout_gives_the_same_bits(tmp_path):
    """Compare three updates in a row with one update, a checkpoint, and two in a new process."""
    code = """
import pickle, sys
import jax, numpy as np
from experiments.config.compose import load_config
from experiments.storage.checkpoints import Checkpoints
from experiments.training.experiment import build_experiment
from pathlib import Path
import sndjax

place, part = Path(sys.argv[1]), sys.argv[2]
config = load_config("env=MountainCar algo=snd_vic num_envs=4 rollout_length=32 num_seeds=2 "
                     "ppo.minibatch_size=64 algo.minibatch_size=64".split())
experiment = build_experiment(config)
step = jax.jit(experiment.make_train_step())
checkpoints = Checkpoints(place)
if part == "whole":
    state = experiment.init_states()
    collector = experiment.make_collector()
    batches = []
    for i in range(3):
        actor = sndjax.Actor(state.policy, state.observations, state.key)
        batch, _ = collector.collect(actor)
        batches.append(jax.tree.map(np.array, batch))
        state, *_ = step(state, batches[-1])
        if i == 0:
            checkpoints.save(1, state, {})
            checkpoints.wait()
    (place / "batches").write_bytes(pickle.dumps(batches))  # our own, of this test
else:
    assert checkpoints.find(lambda manifest: None)[0] == 1
    state = checkpoints.load(1, experiment.run_shapes().train)
    for batch in pickle.loads((place / "batches").read_bytes())[1:]:
        state, *_ = step(state, batch)
state = state._replace(key=jax.random.key_data(state.key))
leaves = [np.asarray(x) for x in jax.tree.leaves(state)]
np.savez(place / part, *leaves)
"""
    for part in ("whole", "resumed"):
        subprocess.run([sys.executable, "-c", code, str(tmp_path), part], check=True)
    with np.load(tmp_path / "whole.npz") as whole, np.load(tmp_path / "resumed.npz") as resumed:
        assert len(whole.files) > 50
        for name in whole.files:
            np.testing.assert_array_equal(whole[name], resumed[name])
