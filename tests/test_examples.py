"""The examples, run as their first lines say."""

import importlib.util
import json
from pathlib import Path

import pytest

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


def test_an_agent_that_is_not_ours_explores_with_the_bonus_and_not_without():
    agent = load("own_agent")
    assert agent.train(0.0) == 0
    assert agent.train(0.1) > 0.9


def test_they_are_as_short_as_they_claim():
    lines = lambda name: len((EXAMPLES / name).read_text().splitlines())
    assert lines("own_agent.py") < 60
    assert lines("my_bonus.py") < 40


def test_a_new_objective_is_used_from_the_command_line_and_learns(tmp_path, monkeypatch):
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
    # Going on with it needs the code named again.
    assert main([f"resume={tmp_path / 'r'}"]) == 2
    assert main([f"resume={tmp_path / 'r'}", bonus]) == 0


@pytest.mark.parametrize("image", [False, True])
def test_an_environment_of_ones_own_trains(image, tmp_path, monkeypatch):
    monkeypatch.chdir(EXAMPLES.parent)
    arguments = [
        "env=gymnasium", "env.id=examples.own_environment:Corridor-v0", "algo=snd_vic", *SMALL,
        "num_envs=2", f"env.options.image={image}", f"run_dir={tmp_path / 'r'}", "total_steps=128",
        "ppo.epochs=1",
    ]  # fmt: skip
    assert main(arguments) == 0
    entries = metrics(tmp_path / "r")
    assert [entry["step"] for entry in entries] == [64, 128]
    assert entries[-1]["transitions"] == 128 - 2  # each corridor reset once, at its limit of 60
    assert entries[-1]["episodes"] == 2
