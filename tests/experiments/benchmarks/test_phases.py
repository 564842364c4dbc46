import json
import os
import subprocess
import sys

import pytest
from helpers.processes import ROOT

from experiments.bench import main
from experiments.benchmarks import timing
from experiments.benchmarks.phases import timed_steps
from experiments.config.compose import load_config

SMALL = ["num_envs=8", "rollout_length=16", "ppo.minibatch_size=32"]
MODULE = "algo.minibatch_size=32"


@pytest.fixture
def quick(monkeypatch):
    """Use a small matrix product; no test here depends on its rate."""
    monkeypatch.setattr(timing, "MATMUL_SIZE", 256)


@pytest.mark.parametrize(
    "command",
    [
        ["env=MountainCar", "algo=ppo"],
        ["env=MountainCar", "algo=snd_vic", MODULE, "num_seeds=2", "--whole"],
        pytest.param(
            ["env=MountainCar", "env.suite=gymnax", "algo=rnd", MODULE],
            marks=pytest.mark.exhaustive,
        ),
        pytest.param(["env=Coinrun", "network=small", "algo=ppo"], marks=pytest.mark.exhaustive),
        ["env=gymnasium", "env.id=CartPole-v1", "algo=snd_vic", MODULE, "overlap=1", "--whole"],
    ],
)
def test_bench_last_line_is_json_with_consistent_figures(command, quick, capfd):
    assert main([*command, *SMALL]) == 0
    lines = capfd.readouterr().out.splitlines()
    found = json.loads(lines[-1])
    phases = found["seconds_per_1000_steps"]
    apart = command[0] in ("env=Coinrun", "env=gymnasium")
    collecting = {"environment", "acting"} if apart else {"collecting"}
    assert set(phases) == collecting | {"rewards", "policy", "motivation"}
    assert phases["policy"] > 0
    assert (phases["motivation"] > 0) == ("algo=ppo" not in command)
    assert found["steps_per_second"] == pytest.approx(1000 / sum(phases.values()))
    assert found["share_of_peak"] == pytest.approx(
        found["steps_per_second"] * found["nominal_gflop_per_step"] / found["matmul_gflops"]
    )
    assert found["compile_seconds"] > found["compile_seconds_cached"] > 0
    assert found["peak_rss_mb"] > 100
    assert ("phases_over_whole" in found) == ("--whole" in command)
    if "--whole" in command:
        assert found["phases_over_whole"] == pytest.approx(
            found["whole_steps_per_second"] / found["steps_per_second"]
        )
    assert ("of_the_slower" in found) == ("overlap=1" in command)


def test_bench_without_analytic_flops_prints_none(quick, capfd):
    command = ["env=MountainCar", "algo=grid", "algo.objective=vicreg", "algo.signal=re3"]
    assert main([*command, *SMALL, MODULE]) == 0
    found = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert found["nominal_gflop_per_step"] is None
    assert found["share_of_peak"] is None


def test_timed_steps_are_whole_minibatches():
    config = load_config(["env=Venture", "algo=snd_std"])
    assert timed_steps(config, pixels=True) == 12  # with 128 environments: three minibatches of 512
    assert timed_steps(config, pixels=False) == 128
    odd = load_config(["env=MountainCar", "algo=ppo", "num_envs=8", "ppo.minibatch_size=1024"])
    assert timed_steps(odd, pixels=True) * 8 % 1024 == 0


@pytest.mark.parametrize(
    "arguments", [["env=Venture"], ["env=MountainCar", "algo=ppo", "run_dir=x"]]
)
def test_bench_bad_input_is_one_line(arguments, tmp_path):
    command = [sys.executable, "-m", "experiments.bench", *arguments]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert not list(tmp_path.iterdir())
