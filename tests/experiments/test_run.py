"""Run the command as a user does: in a separate process, on real environments."""

import math
import os

import pytest
from helpers.processes import CAR, SMALL, lines, run

from experiments.config.schema import SIGNALS
from experiments.run import main
from sndjax.algorithms import NAMED

ACTIONS = {"Venture": 18, "Coinrun": 15, "MountainCar": 3}


def train(path, *arguments):
    status, out, err = run([*arguments, f"run_dir={path}"], path.parent)
    assert status == 0, err
    assert "Traceback" not in err
    return out


FOUR = ["ppo", "rnd", "snd_std", "snd_vic"]
DEFAULT = [*(f"algo={algo}" for algo in [*FOUR, "icm"]), "algo.signal=ngu", "algo.signal=re3"]
RUNS = [
    pytest.param(
        env, [f"algo={algo}"], marks=pytest.mark.exhaustive if algo in ("rnd", "snd_vic") else ()
    )
    for env in ("Venture", "Coinrun")
    for algo in FOUR
]
GRID = ["algo=grid", "algo.objective=vicreg"]
RUNS += [
    pytest.param(
        "MountainCar", arguments, marks=() if arguments[-1] in DEFAULT else pytest.mark.exhaustive
    )
    for arguments in [
        *([f"algo={algo}"] for algo in NAMED),
        *([*GRID, f"algo.signal={signal}"] for signal in SIGNALS),
    ]
]


@pytest.mark.parametrize(
    ("env", "algorithm"), RUNS, ids=lambda x: x if isinstance(x, str) else x[-1]
)
def test_run_every_algorithm_on_every_kind_of_environment_trains(
    env, algorithm, tmp_path, capfd, monkeypatch
):
    """Call the entry function of the command in this process."""
    path = tmp_path / "run"
    monkeypatch.chdir(tmp_path)
    baseline = algorithm == ["algo=ppo"]
    more = [] if baseline else ["algo.minibatch_size=64"]
    arguments = [f"env={env}", *algorithm, *SMALL, "total_steps=256", f"run_dir={path}", *more]
    assert main(arguments) == 0
    out = capfd.readouterr().out
    entries = lines(path)
    assert [entry["step"] for entry in entries] == [128, 256]
    skip = 4 if env == "Venture" else 1
    for entry in entries:
        assert entry["frames"] == entry["step"] * skip
        assert 0 < entry["entropy"] <= math.log(ACTIONS[env]) + 1e-5
        for key, value in entry.items():
            assert value is None or math.isfinite(value), key
        if not baseline:
            assert entry["int_reward_mean"] > 0
            assert 0 <= entry["int_reward_clipped"] <= 1
    assert "step 256 of 256" in out
    assert "clipped" in out
    left = {p.name for p in path.iterdir()}
    assert left == {
        "config.yaml", "metrics.jsonl", "episodes.csv", "times.jsonl", "summary.json",
        "tensorboard", "checkpoints", ".lock",
    }  # fmt: skip
    assert [p.name for p in tmp_path.iterdir()] == ["run"]  # no outputs/ folder


@pytest.mark.parametrize(
    "env", ["MountainCar", pytest.param("Venture", marks=pytest.mark.exhaustive)]
)
def test_run_several_seeds_each_starts_as_it_would_alone(env, tmp_path):
    common = [f"env={env}", "algo=snd_vic", *SMALL, "algo.minibatch_size=64", "total_steps=256"]
    train(tmp_path / "many", *common, "num_seeds=2", "seed=4")
    train(tmp_path / "alone", *common, "seed=5")
    many = [entry for entry in lines(tmp_path / "many") if entry["seed"] == 5]
    assert len(many) == 2
    assert {entry["seed"] for entry in lines(tmp_path / "many")} == {4, 5}
    for one, other in zip(many, lines(tmp_path / "alone"), strict=True):
        for key, value in one.items():
            if isinstance(value, float):
                assert other[key] == pytest.approx(value, rel=0.02, abs=1e-4), key
            else:
                assert other[key] == value, key


REFUSED = [
    (["env=Ventur", "algo=rnd"], "did you mean Venture"),
    (["env=Venture", "algo=rnd", "ppo.minibatch_size=500"], "does not divide the rollout"),
    (["env=Venture", "algo=rnd", "num_envs=0"], "at least 1"),
    (["env=Venture", "algo=rnd", "algo.eta=-1"], "at least 0"),
    (["env=Venture", "algo=rnd", "run_dir=/proc/x"], "cannot write to /proc/x"),
    (["env=Venture", "algo=rnd", "run_dir={full}"], "not empty"),
    (["env=envpool", "env.id=Pendulum-v1", "algo=rnd"], "only tasks with discrete actions"),
    (["resume={full}"], "there is no run"),
    ([], "give env=NAME"),
]


@pytest.mark.parametrize(("arguments", "words"), REFUSED, ids=lambda x: str(x)[-30:])
def test_run_bad_input_is_one_line_and_status_2_within_five_seconds(arguments, words, tmp_path):
    full = tmp_path / "full"
    full.mkdir()
    (full / "mine").write_text("")
    before = os.times()
    status, out, err = run([a.format(full=full) for a in arguments], tmp_path)
    after = os.times()
    # Processor time does not count the other work of the machine.
    assert (
        after.children_user + after.children_system
        < before.children_user + before.children_system + 5
    )
    assert status == 2
    assert out == ""
    assert len(err.splitlines()) == 1
    assert words in err
    assert [p.name for p in tmp_path.iterdir()] == ["full"]
    assert [p.name for p in full.iterdir()] == ["mine"]


def test_run_option_refused_by_envpool_leaves_nothing(tmp_path):
    arguments = ["env=Venture", "algo=rnd", "env.options.no_such=1", f"run_dir={tmp_path / 'run'}"]
    status, _, err = run(arguments, tmp_path)
    assert status == 2
    assert len(err.splitlines()) == 1
    assert "envpool cannot make Venture-v5" in err
    assert list(tmp_path.iterdir()) == []


def test_run_resume_with_another_configuration_is_refused(tmp_path):
    train(tmp_path / "run", *CAR, "algo=ppo", "total_steps=256")
    before = (tmp_path / "run" / "metrics.jsonl").read_bytes()
    for change, words in (
        ("algo=rnd", "algo=ppo, not rnd"),
        ("ppo.clip=0.3", "ppo.clip=0.1, not 0.3"),
    ):
        status, _, err = run([f"resume={tmp_path / 'run'}", change], tmp_path)
        assert status == 2
        assert words in err
    assert (tmp_path / "run" / "metrics.jsonl").read_bytes() == before


def test_run_help_explains_every_option(tmp_path):
    status, out, _ = run(["--help"], tmp_path)
    assert status == 0
    for word in ("MontezumaRevenge", "snd_std", "ppo.learning_rate=0.0001", "num_seeds="):
        assert word in out


@pytest.mark.exhaustive
def test_run_novelty_only_and_other_games_train(tmp_path):
    train(tmp_path / "car", *CAR, "algo=snd_vic", "ppo.ext_weight=0", "total_steps=256")
    train(
        tmp_path / "pong", "env=envpool", "env.id=Pong-v5", "algo=rnd", *SMALL,
        "algo.minibatch_size=64", "total_steps=128",
    )  # fmt: skip
    assert len(lines(tmp_path / "pong")) == 1
