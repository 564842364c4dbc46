"""Compare real runs on forced host devices and in two processes with a run on one device."""

import json
import os
import shutil
import socket
import subprocess
import sys

import numpy as np
import pytest
from helpers.processes import ROOT

CAR = ["env=MountainCar", "num_envs=8", "rollout_length=64", "ppo.minibatch_size=256"]
CAR += ["algo.minibatch_size=256", "ppo.epochs=2"]
PLAIN = ["algo=snd_vic"]
# Episodic memory of every environment, frame stacks, and random numbers in the loss.
EPISODIC = ["algo=grid", "algo.objective=contrastive", "algo.signal=ngu", "env.stack=2"]
STEPS = 512  # in an iteration


def start(path, devices, *arguments, **more):
    flags = f"--xla_force_host_platform_device_count={devices}"
    environment = os.environ | {"PYTHONPATH": str(ROOT), "XLA_FLAGS": flags} | more
    command = [sys.executable, "-m", "experiments.run", *CAR, *arguments, f"run_dir={path}"]
    iterations = 6 if "resume=auto" in arguments else 5
    command += [f"total_steps={STEPS * iterations}"]
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


def assert_same(path, other, tolerance=1e-3):
    """Check that episodes are the same, and figures equal up to the order of summation."""
    mine, theirs = log(path), log(other)
    assert len(mine) == len(theirs) >= 5
    for a, b in zip(mine, theirs, strict=True):
        assert a.keys() == b.keys()
        for key in a:
            if "second" in key or "rss" in key:
                continue
            if isinstance(a[key], float):
                np.testing.assert_allclose(a[key], b[key], tolerance, 1e-5, err_msg=key)
            else:
                assert a[key] == b[key], key
    episodes, others = (
        np.genfromtxt(p / "episodes.csv", delimiter=",", names=True) for p in (path, other)
    )
    assert episodes.size >= 8  # at least the first of every environment
    for name in ("seed", "step", "length", "ext_return", "score"):
        np.testing.assert_array_equal(episodes[name], others[name])
    np.testing.assert_allclose(episodes["int_return"], others["int_return"], tolerance)


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Return a function that gives a run on one device, by its algorithm and number of seeds."""
    found = {}

    def of(algo, seeds):
        key = (*algo, seeds)
        if key not in found:
            found[key] = tmp_path_factory.mktemp("alone") / "run"
            finish(start(found[key], 1, *algo, f"num_seeds={seeds}"))
        return found[key]

    return of


@pytest.mark.parametrize(
    ("devices", "seeds", "algo"),
    [
        (2, 1, PLAIN),  # environments over two devices
        (4, 2, EPISODIC),  # seeds over two, and environments over two
    ],
)
def test_run_several_devices_equals_the_run_on_one(devices, seeds, algo, alone, tmp_path):
    finish(start(tmp_path / "run", devices, *algo, f"num_seeds={seeds}"))
    assert_same(tmp_path / "run", alone(algo, seeds))


def test_run_environments_that_devices_cannot_divide_is_refused(tmp_path):
    process = start(tmp_path / "run", 3, *PLAIN)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 2
    assert "num_envs=8 cannot be divided among 3 devices" in err
    assert not (tmp_path / "run").exists()


def both(path, *arguments):
    """Start the two processes of a run."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        place = f"localhost:{free.getsockname()[1]}"
    own = {"JAX_COORDINATOR_ADDRESS": place, "JAX_NUM_PROCESSES": "2"}
    common = ["distributed=true", *PLAIN, *arguments]
    return [start(path, 1, *common, **own, JAX_PROCESS_ID=str(k)) for k in range(2)]


def test_run_two_processes_train_together_and_each_can_resume(alone, tmp_path):
    """Resume the run also in one process, with the same results."""
    finish(*both(tmp_path / "run"))
    assert_same(tmp_path / "run", alone(PLAIN, 1))
    shutil.copytree(tmp_path / "run", tmp_path / "other")
    finish(*both(tmp_path / "run", "resume=auto"))
    finish(start(tmp_path / "other", 1, *PLAIN, "resume=auto"))
    assert [line["step"] for line in log(tmp_path / "run")] == [STEPS * i for i in range(1, 7)]
    assert_same(tmp_path / "run", tmp_path / "other")


def test_run_two_processes_bad_directory_of_one_stops_both(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "mine.txt").touch()
    for process in both(tmp_path / "run"):
        _, err = process.communicate(timeout=120)
        assert process.returncode == 2
        assert "Traceback" not in err
        assert "is not empty" in err or "some hosts were refused" in err


def test_run_distributed_without_coordinator_names_the_missing_variable(tmp_path):
    process = start(tmp_path / "run", 1, *PLAIN, "distributed=true")
    _, err = process.communicate(timeout=120)
    assert process.returncode == 2
    assert "JAX_COORDINATOR_ADDRESS" in err
    assert "Traceback" not in err


PLACES = """
import sys
import jax
from experiments.config.compose import load_config
from experiments.training.device_mesh import choose_placement

config = load_config(sys.argv[1:])
found = choose_placement(config)
learning = found.mesh.devices.flatten().tolist() if found.axis else [found.device]
print([getattr(d, "id", None) for d in learning], getattr(found.acting.device, "id", None))
"""


@pytest.mark.parametrize(
    ("devices", "arguments", "expected"),
    [
        (1, ["overlap=1"], "[None] None"),
        (2, ["overlap=1"], "[0] 1"),
        (3, ["overlap=1"], "[0, 1] 2"),
        (4, ["overlap=1", "num_envs=32"], "[0, 1] 3"),  # three cannot share 32 environments
        (2, [], "[0, 1] None"),
        (2, ["overlap=1", "env.suite=gymnax"], "[0, 1] None"),  # one program does both
    ],
)
def test_choose_placement_overlap_gives_the_last_device_to_the_policies(
    devices, arguments, expected
):
    flags = f"--xla_force_host_platform_device_count={devices}"
    done = subprocess.run(
        [sys.executable, "-c", PLACES, "env=MountainCar", "algo=rnd", *arguments],
        env=os.environ | {"PYTHONPATH": str(ROOT), "XLA_FLAGS": flags},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == expected


def test_run_overlap_on_a_device_of_its_own_equals_overlap_on_one(tmp_path):
    for name, devices in (("one", 1), ("three", 3)):
        finish(start(tmp_path / name, devices, *PLAIN, "overlap=1"))
    assert_same(tmp_path / "three", tmp_path / "one")


def test_run_overlap_of_frames_collected_on_a_device_of_its_own_equals_one_device(tmp_path):
    game = ["env=gymnasium", "env.id=examples.own_environment:Corridor-v0", "algo=rnd"]
    game += ["env.options.image=true", "network=small", "num_envs=4", "rollout_length=16"]
    game += ["ppo.minibatch_size=32", "algo.minibatch_size=32", "overlap=1", "total_steps=256"]
    for name, devices in (("one", 1), ("two", 2)):
        flags = f"--xla_force_host_platform_device_count={devices}"
        done = subprocess.run(
            [sys.executable, "-m", "experiments.run", *game, f"run_dir={tmp_path / name}"],
            env=os.environ | {"PYTHONPATH": str(ROOT), "XLA_FLAGS": flags},
            cwd=ROOT,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        assert ("gains nothing" in done.stdout) == (devices == 1)
    assert log(tmp_path / "one") == log(tmp_path / "two")
