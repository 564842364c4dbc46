"""Test `random_agent` on tasks with known results."""

import re

import numpy as np
import pytest

from experiments.benchmarks.random_agent import repeat_actions
from experiments.random_agent import main

POLE = ["env=envpool", "env.id=CartPole-v1", "num_envs=16", "total_steps=20_000"]


def test_repeat_actions_new_draw_in_one_of_five_keeps_expected_share():
    rng, actions = np.random.default_rng(0), 4
    action = rng.integers(0, actions, 2000)
    same = []
    for _ in range(100):
        after = repeat_actions(rng, action, actions, 1 / 5)
        same.append(after == action)
        action = after
    # Kept or drawn again: 1 - 1/5 + 1/5 * 1/4; the standard error of 200,000 samples is 0.0008.
    assert abs(np.mean(same) - 0.85) < 0.004
    counts = np.bincount(action, minlength=actions)
    assert abs(counts - 500).max() < 100


def figures(capsys):
    said = capsys.readouterr().out
    rewarded, of = re.search(r": (\d+) of ([\d,]+) episodes", said).groups()
    length = re.search(r"mean length (\d+)", said).group(1)
    return int(rewarded), int(of.replace(",", "")), int(length), said


def test_random_agent_cartpole_every_step_is_rewarded_for_22_steps(capsys):
    assert main(POLE) == 0
    rewarded, of, length, said = figures(capsys)
    assert rewarded == of
    assert abs(of * length - 20_000) < 2_000
    assert 20 <= length <= 24  # published for a random policy: about 22
    assert "the first by step 16;" in said
    assert main([*POLE, "keep=20"]) == 0
    assert figures(capsys)[2] < 18  # one constant action: it falls after 8 to 10 steps
    assert main([*POLE, "keep=20", "env.random_action=1"]) == 0
    assert 20 <= figures(capsys)[2] <= 24  # random actions of the environment are not repeated


def test_random_agent_mountain_car_is_never_rewarded(capsys):
    assert main(["env=MountainCar", "num_envs=8", "total_steps=20_000"]) == 0
    rewarded, of, length, said = figures(capsys)
    assert (rewarded, length) == (0, 200)
    assert 92 <= of <= 100
    assert "no reward" in said


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["keep=0.5"], "at least 1"),
        (["total_steps=32"], "no episode ended"),
        (["algo=rnd"], "algo"),
        (["kep=3"], "unknown option 'kep'; see --help"),
    ],
)
def test_random_agent_bad_input_is_one_line(more, said, capsys):
    assert main(["env=MountainCar", "num_envs=8", *more]) == 2
    (line,) = [x for x in capsys.readouterr().err.splitlines() if x.startswith("sndjax:")]
    assert said in line
