import json

import numpy as np
import pytest

from experiments import novelty
from experiments.analysis import novelty_report
from experiments.analysis.montezuma_path import Trajectory, load_committed_trajectory
from experiments.analysis.novelty_study import NEAR, STEPS, draw_windows, gather_runs, study_module

ALGOS = ["rnd", pytest.param("snd_vic", marks=pytest.mark.exhaustive)]


@pytest.fixture(scope="module")
def walk():
    whole = load_committed_trajectory()
    return Trajectory(whole.frames[:330], whole.action[:329], whole.room[:329])


def test_gather_runs_minibatches_are_consecutive_pairs(walk):
    start = np.array([[0, 7], [30, 2]])
    rollout = gather_runs(walk, start, STEPS)
    assert rollout.frames.shape == (2, STEPS + 1, 2, 96, 96, 1)
    for k in range(2):
        for t in range(STEPS):
            for n in range(2):
                m = start[k, n] + t
                np.testing.assert_array_equal(rollout.frames[k, t + 1, n], walk.frames[m + 1])
                assert rollout.action[k, t, n] == walk.action[m]


def test_draw_windows_several_positions_lie_in_their_ranges():
    draw = np.random.default_rng(0)
    for n in (1, 40, 171):
        past, near, far, anywhere = draw_windows(n, 300, draw)
        assert past.max() < n
        np.testing.assert_array_equal(near, np.arange(n + 1, n + NEAR))
        assert n < far.min() <= far.max() <= 300
        assert 0 <= anywhere.min() <= anywhere.max() <= 300


@pytest.mark.parametrize("algo", ALGOS)
def test_study_module_future_states_change_nothing_learned(walk, algo):
    """Invert the future frames; the same weights and running statistics give the same past."""
    frames = walk.frames.copy()
    frames[129:] = 255 - frames[129:]
    other = walk._replace(frames=frames)
    where, means = study_module(algo, walk, 32, 64, 0)
    _, others = study_module(algo, other, 32, 64, 0)
    assert where.tolist() == [64, 128, 192]
    np.testing.assert_array_equal(means[:2, 0], others[:2, 0])
    assert (means[:2, 2] != others[:2, 2]).all()
    assert means[2, 0] != others[2, 0]


def test_novelty_second_call_reuses_stored_study(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments = ["algos=rnd", "states=300", "train_every=32", "read_every=32", "out=found"]
    assert novelty.main(arguments) == 0
    first = (tmp_path / "found" / "rnd.json").read_bytes()
    stored = json.loads(first)
    assert stored["n"] == [32, 64, 96, 128, 160]
    ratio = np.median(np.array(stored["far"]) / np.array(stored["past"]))
    for name in ("index.html", "novelty.csv", "novelty-rnd.png", "novelty-rnd.svg"):
        assert (tmp_path / "found" / name).stat().st_size
    monkeypatch.setattr(novelty_report, "study_module", None)  # a stored study is reused
    assert novelty.main(arguments) == 0
    assert (tmp_path / "found" / "rnd.json").read_bytes() == first
    assert f"{ratio:.2f}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("algos=rnd,nothing", "unknown algo"),
        ("algos=ppo", "no novelty"),
        ("read_every=6", "multiple"),
        ("env=Venture", "unknown value of env"),
        ("states=100", "at least 300"),
        ("out=/proc/none", "No such file"),
        ("train_every=2", "at least 4"),
    ],
)
def test_novelty_bad_input_is_refused_with_reason(given, said, capsys):
    assert novelty.main([given]) == 2
    assert said in capsys.readouterr().err
