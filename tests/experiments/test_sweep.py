"""Sweeps as a user starts them: killed half-way by launcher and by hand, done by a second one."""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from experiments import cells
from experiments.options import ConfigError

ROOT = Path(__file__).parents[2]
EIGHT = ["env=MountainCar", "algo=ppo,snd_vic", "seed=0,9", "ppo.epochs=1,2"]
SMALL = ["num_envs=4", "rollout_length=32", "ppo.minibatch_size=64"]


def needs(package):
    missing = importlib.util.find_spec(package) is None
    return pytest.mark.skipif(missing, reason=f"{package} is not installed")


def start(directory, *arguments):
    """A sweep in a process of its own."""
    command = [sys.executable, "-m", "experiments.run", "-m", *arguments]
    return subprocess.Popen(
        [*command, f"hydra.sweep.dir={directory}"],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        cwd=directory.parent,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def sweep(directory, *arguments):
    out, err = start(directory, *arguments).communicate(timeout=600)
    assert "Traceback" not in out + err
    return out, err


def parent(pid):
    """The parent of a process."""
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def waits(condition, seconds=120):
    """Wait until something holds; what it then is."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if found := condition():
            return found
        time.sleep(0.2)
    raise AssertionError("it never came")


def survey(directory):
    """How far its cells are, once it has any."""
    with suppress(ConfigError):
        return cells.survey(directory)
    return []


def running(directory):
    """The processes of the cells that run."""
    known = cells.known(directory)
    return [
        (last["pid"], cell)
        for cell, last in known
        if "pid" in last and cells.is_held(directory, cell.name)
    ]


@pytest.mark.parametrize("launcher", ["joblib", pytest.param("ray", marks=needs("ray"))])
def test_a_sweep_whose_worker_is_killed_is_completed_by_running_again(launcher, tmp_path):
    directory = tmp_path / "sweep"
    command = [*EIGHT, *SMALL, "total_steps=20_000", f"hydra/launcher={launcher}"]
    with start(directory, *command) as process:
        waits(lambda: any(s.state == "done" for s in survey(directory)))
        pid, victim = waits(lambda: running(directory))[0]
        os.kill(parent(pid), signal.SIGKILL)  # the worker that waits for it
        process.communicate(timeout=300)
    if launcher == "joblib":  # Ray begins a task again whose worker died
        assert process.returncode == 2
    before = {s.cell.name: s.state for s in survey(directory)}
    assert "done" in before.values()
    done = {name: log(directory, name) for name, state in before.items() if state == "done"}
    out, err = sweep(directory, *command)
    assert f"{len(done)} done already" in out, err
    assert {s.state for s in survey(directory)} == {"done"}
    assert victim.name in {s.cell.name for s in survey(directory)}
    for name, text in done.items():
        assert log(directory, name) == text  # not run again
    for s in survey(directory):
        steps = [json.loads(line)["step"] for line in log(directory, s.cell.name).splitlines()]
        assert steps == [128 * (i + 1) for i in range(157)]


def log(directory, name):
    return (directory / name / "metrics.jsonl").read_text()


def test_a_bad_cell_fails_alone_and_by_name_before_the_others_start(tmp_path):
    directory = tmp_path / "sweep"
    out, _ = sweep(
        directory,
        "env=MountainCar",
        "algo=ppo",
        "ppo.minibatch_size=64,63",
        "num_envs=4",
        "rollout_length=32",
        "total_steps=128",
    )
    first = out.splitlines()[0]
    assert "2 cells: 1 failed before" not in first
    assert "cannot run: MountainCar/ppo/0,ppo.minibatch_size=63" in out
    assert {s.cell.name[-2:]: s.state for s in survey(directory)} == {"64": "done", "63": "failed"}
    status = [sys.executable, "-m", "experiments.sweep", "status", str(directory)]
    shown = subprocess.run(status, capture_output=True, text=True, cwd=ROOT, check=True).stdout
    assert "does not divide the rollout" in shown
    assert "2 cells: 1 done, 1 failed" in shown


def test_an_interrupted_sweep_leaves_checkpoints_and_says_how_to_go_on(tmp_path):
    directory = tmp_path / "sweep"
    with start(directory, "env=MountainCar", "algo=ppo", "seed=0,1,2", *SMALL) as process:
        waits(lambda: len([s for s in survey(directory) if s.step]) == 2)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "interrupted; the same command goes on" in out
    assert "Traceback" not in out + err
    states = sorted(s.state for s in survey(directory))
    assert states == ["stopped", "stopped", "waiting"]
    for s in survey(directory):
        if s.state == "stopped":  # to the last step that was logged
            steps = [
                int(path.name) for path in (directory / s.cell.name).glob("checkpoints/[0-9]*")
            ]
            assert max(steps) * 128 == s.step


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["env=MountainCa", "algo=ppo"], "did you mean MountainCar"),
        (["sweep=smal"], "did you mean small"),
        (["env=MountainCar", "algo=ppo", "hydra/launcher=nowhere"], "nowhere"),
        (["env=MountainCar", "algo"], "write key=value"),
    ],
)
def test_a_sweep_of_which_nothing_can_run_is_refused(arguments, words, tmp_path):
    process = start(tmp_path / "sweep", *arguments)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 2, out + err
    assert words in err
    assert "Traceback" not in err
    assert not (tmp_path / "sweep").exists()


@needs("optuna")
def test_a_search_maximises_what_its_cells_return(tmp_path):
    directory = tmp_path / "sweep"
    out, err = sweep(
        directory,
        "sweep=eta",
        "env=MountainCar",
        "algo=snd_vic",
        *SMALL,
        "total_steps=1000",
        "hydra.sweeper.n_trials=2",
    )
    found = survey(directory)
    assert len(found) == 2, out + err
    assert {s.state for s in found} == {"done"}
    assert all("algo.eta=" in s.cell.name and "learning_rate=" in s.cell.name for s in found)
    assert (directory / "optimization_results.yaml").is_file()
