"""Test `multirun` as a user runs it: killed, interrupted, and completed by the same command."""

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
from helpers.processes import ROOT

from experiments.sweeps import job_status, jobs
from experiments.system.errors import ConfigError

EIGHT = ["env=MountainCar", "algo=ppo,snd_vic", "seed=0,9", "ppo.epochs=1,2"]
SMALL = ["num_envs=4", "rollout_length=32", "ppo.minibatch_size=64"]


def needs(package):
    missing = importlib.util.find_spec(package) is None
    return pytest.mark.skipif(missing, reason=f"{package} is not installed")


def start(directory, *arguments):
    """Start a sweep in its own process."""
    command = [sys.executable, "-m", "experiments.run", "-m", *arguments]
    return subprocess.Popen(
        [*command, f"hydra.sweep.dir={directory}"],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        cwd=directory.parent,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def sweep(directory, *arguments, status=0):
    """Run a sweep; return its output."""
    process = start(directory, *arguments)
    out, err = process.communicate(timeout=600)
    assert "Traceback" not in out + err
    assert process.returncode == status, out + err
    return out


def parent(pid):
    """Return the parent of a process."""
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def waits(condition, seconds=120):
    """Wait until a condition is true; return its value."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if found := condition():
            return found
        time.sleep(0.2)
    raise AssertionError("it never came")


def survey(directory):
    """Return the states of the jobs; an empty list before the sweep has any."""
    with suppress(ConfigError):
        return job_status.job_statuses(directory)
    return []


def running(directory):
    """Return the process id and the job of every running job."""
    known = jobs.read_jobs(directory)
    return [
        (last["pid"], job)
        for job, last in known
        if "pid" in last and job_status.is_locked(directory, job.name)
    ]


RAY = pytest.param("ray", marks=[needs("ray"), pytest.mark.survival])  # a minute


@pytest.mark.parametrize("launcher", ["joblib", RAY])
def test_multirun_worker_killed_is_completed_by_running_again(launcher, tmp_path):
    directory = tmp_path / "sweep"
    command = [*EIGHT, *SMALL, "total_steps=8_000", f"hydra/launcher={launcher}"]
    with start(directory, *command) as process:
        waits(lambda: any(s.state == "done" for s in survey(directory)))
        pid, victim = waits(lambda: running(directory))[0]
        os.kill(parent(pid), signal.SIGKILL)  # the worker of this job
        if launcher == "joblib":
            _, err = process.communicate(timeout=300)
            assert "the launcher gave up" in err
            assert process.returncode == 1
        else:  # Ray restarts a task whose worker died, so the whole sweep is killed
            waits(lambda: job_status.is_locked(directory, victim.name))
            process.kill()
            process.communicate(timeout=60)
    waits(lambda: not running(directory))
    before = {s.job.name: s.state for s in survey(directory)}
    assert set(before.values()) > {"done"}
    done = {name: log(directory, name) for name, state in before.items() if state == "done"}
    out = sweep(directory, *command)
    assert f"{len(done)} done already" in out
    assert {s.state for s in survey(directory)} == {"done"}
    assert (directory / "report" / "index.html").is_file()
    for name, text in done.items():
        assert log(directory, name) == text  # not run again
    for s in survey(directory):
        steps = [json.loads(line)["step"] for line in log(directory, s.job.name).splitlines()]
        assert steps == [128 * (i + 1) for i in range(63)]


def log(directory, name):
    return (directory / name / "metrics.jsonl").read_text()


@pytest.mark.parametrize(
    "launcher", ["joblib", pytest.param("submitit_local", marks=needs("submitit"))]
)
def test_multirun_bad_job_is_named_before_the_others_start(launcher, tmp_path):
    directory = tmp_path / "sweep"
    command = ["env=MountainCar", "algo=ppo", "num_envs=4", "rollout_length=32", "total_steps=128"]
    command += [f"hydra/launcher={launcher}"]
    out = sweep(directory, *command, "ppo.minibatch_size=64,63", "group=own", status=1)
    bad = "MountainCar/ppo/0,ppo.minibatch_size=63"
    assert "2 jobs: 1 new, 1 that cannot run" in out.partition(f"cannot run: {bad}")[0]
    assert "running" not in out.partition(f"cannot run: {bad}")[0]
    assert {s.job.name[-2:]: s.state for s in survey(directory)} == {"64": "done", "63": "failed"}
    status = [sys.executable, "-m", "experiments.sweep", "status", str(directory)]
    shown = subprocess.run(status, capture_output=True, text=True, cwd=ROOT, check=True).stdout
    assert "does not divide the rollout" in shown
    assert "2 jobs: 1 done, 1 failed" in shown
    # Without the bad job the sweep is complete.
    assert "1 done already" in sweep(
        directory, *command, "ppo.minibatch_size=choice(64)", "group=own"
    )


def test_multirun_extended_sweep_refuses_jobs_of_another_configuration(tmp_path):
    directory = tmp_path / "sweep"
    command = ["env=MountainCar", "algo=ppo", "seed=3", *SMALL]
    sweep(directory, *command, "total_steps=128")
    out = sweep(directory, *command, "total_steps=128", "ppo.clip=0.3", status=1)
    assert "cannot run: MountainCar/ppo/3: resume=auto: the run" in out
    assert "has ppo.clip=0.1, not 0.3" in out
    out = sweep(directory, *command, "total_steps=256", "ppo.clip=0.1")
    assert "1 to resume" in out
    assert [s[1:3] for s in survey(directory)] == [("done", 256)]


def test_multirun_job_finished_by_hand_counts_as_done(tmp_path):
    directory = tmp_path / "sweep"
    mine = ["env=MountainCar", "algo=ppo", *SMALL, "total_steps=128"]
    run = [sys.executable, "-m", "experiments.run", *mine, "seed=3"]
    run += [f"run_dir={directory / 'MountainCar' / 'ppo' / '3'}"]
    subprocess.run(run, cwd=ROOT, capture_output=True, check=True, timeout=300)
    summary = directory / "MountainCar" / "ppo" / "3" / "summary.json"
    before = summary.stat().st_mtime_ns
    out = sweep(directory, *mine, "seed=choice(3)")
    assert "1 done already" in out
    assert summary.stat().st_mtime_ns == before  # not run again
    (standing,) = job_status.job_statuses(directory)
    assert standing.state == job_status.DONE


def test_multirun_interrupted_leaves_checkpoints_and_prints_how_to_resume(tmp_path):
    directory = tmp_path / "sweep"
    more = ["hydra.launcher.n_jobs=2", *SMALL]
    with start(directory, "env=MountainCar", "algo=ppo", "seed=0,1,2", *more) as process:
        waits(lambda: len([s for s in survey(directory) if s.step]) == 2)
        os.killpg(process.pid, signal.SIGINT)  # as Ctrl-C in a terminal does
        out, err = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "interrupted; to resume, give the same command" in out
    assert "Traceback" not in out + err
    states = sorted(s.state for s in survey(directory))
    assert states == ["stopped", "stopped", "waiting"]
    for s in survey(directory):
        if s.state == "stopped":  # its checkpoint is of the last logged step
            steps = [int(path.name) for path in (directory / s.job.name).glob("checkpoints/[0-9]*")]
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
def test_multirun_no_job_that_can_run_is_refused(arguments, words, tmp_path):
    process = start(tmp_path / "sweep", *arguments)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 2, out + err
    assert words in err
    assert "Traceback" not in err
    assert not (tmp_path / "sweep").exists()


def test_multirun_without_asserts_is_refused_with_the_remedy(tmp_path):
    run = [sys.executable, "-O", "-m", "experiments.run", "-m", "env=MountainCar", "algo=rnd"]
    done = subprocess.run([*run, "seed=range(2)"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2
    assert "+hydra.job.env_set.PYTHONOPTIMIZE=1" in done.stderr
    assert len(done.stderr.splitlines()) == 1


@needs("optuna")
def test_multirun_search_with_optuna_reports_every_trial(tmp_path):
    directory = tmp_path / "sweep"
    out = sweep(
        directory,
        "sweep=eta",
        "env=MountainCar",
        "algo=snd_vic",
        *SMALL,
        "total_steps=1000",
        "hydra.sweeper.n_trials=2",
    )
    found = survey(directory)
    assert len(found) == 2, out
    assert {s.state for s in found} == {"done"}
    assert all("algo.eta=" in s.job.name and "learning_rate=" in s.job.name for s in found)
    head, *rows = (directory / "report" / "search.csv").read_text().splitlines()
    assert head == "mean_ext_return,algo.eta,algo.learning_rate"
    assert len(rows) == 2
    assert (directory / "report" / "search.png").stat().st_size > 1000
    assert "best_value" in (directory / "optimization_results.yaml").read_text()
