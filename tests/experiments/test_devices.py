"""Several devices compute what one computes: real runs on forced host devices and two processes."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
CAR = ["env=MountainCar", "algo=snd_vic", "num_envs=8", "rollout_length=16"]
CAR += ["ppo.minibatch_size=64", "algo.minibatch_size=64"]


def start(path, devices, *arguments, **more):
    flags = f"--xla_force_host_platform_device_count={devices}"
    environment = os.environ | {"PYTHONPATH": str(ROOT), "XLA_FLAGS": flags} | more
    command = [sys.executable, "-m", "experiments.run", *CAR, *arguments, f"run_dir={path}"]
    command += ["total_steps=384"] if "resume=auto" not in arguments else ["total_steps=512"]
    return subprocess.Popen(
        command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def finish(*processes):
    for process in processes:
        out, err = process.communicate(timeout=300)
        assert process.returncode == 0, err
    return out


def log(path):
    return [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]


def assert_same(path, other, tolerance=2e-4):
    """The same episodes, and figures as near as sums in another order come out."""
    mine, theirs = log(path), log(other)
    assert len(mine) == len(theirs) > 2
    assert (path / "episodes.csv").read_text().count("\n") > 0
    for a, b in zip(mine, theirs, strict=True):
        assert a.keys() == b.keys()
        for key in a:
            if "second" in key or "rss" in key:
                continue
            if isinstance(a[key], float):
                np.testing.assert_allclose(a[key], b[key], tolerance, 1e-6, err_msg=key)
            else:
                assert a[key] == b[key], key


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Runs on one device, by their number of seeds."""
    found = {}

    def of(seeds):
        if seeds not in found:
            found[seeds] = tmp_path_factory.mktemp("alone") / "run"
            finish(start(found[seeds], 1, f"num_seeds={seeds}"))
        return found[seeds]

    return of


@pytest.mark.parametrize(
    ("devices", "seeds"), [(2, 1), (4, 2)]
)  # environments over two; seeds over two and environments over two
def test_a_run_on_several_devices_is_the_run_on_one(devices, seeds, alone, tmp_path):
    finish(start(tmp_path / "run", devices, f"num_seeds={seeds}"))
    assert_same(tmp_path / "run", alone(seeds))


def test_environments_that_cannot_be_divided_are_refused(tmp_path):
    process = start(tmp_path / "run", 3)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 2
    assert "num_envs=8 cannot be divided among 3 devices" in err
    assert not (tmp_path / "run").exists()


def test_two_processes_train_one_run_and_go_on_with_it(alone, tmp_path):
    def both(*arguments):
        with socket.socket() as free:
            free.bind(("localhost", 0))
            place = f"localhost:{free.getsockname()[1]}"
        return [
            start(
                tmp_path / "run",
                1,
                "distributed=true",
                "num_seeds=1",
                *arguments,
                JAX_COORDINATOR_ADDRESS=place,
                JAX_NUM_PROCESSES="2",
                JAX_PROCESS_ID=str(k),
            )
            for k in range(2)
        ]

    finish(*both())
    assert_same(tmp_path / "run", alone(1))
    finish(*both("resume=auto"))
    assert [line["step"] for line in log(tmp_path / "run")] == [128, 256, 384, 512]


def test_a_process_that_is_alone_is_told_what_is_missing(tmp_path):
    process = start(tmp_path / "run", 1, "distributed=true")
    _, err = process.communicate(timeout=120)
    assert process.returncode == 2
    assert "JAX_COORDINATOR_ADDRESS" in err
    assert "Traceback" not in err
