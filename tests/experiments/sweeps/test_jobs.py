"""Test the jobs of a sweep: their expansion, their names, and their states read from files."""

import itertools
import json

import pytest

from experiments.sweeps import job_status, jobs
from experiments.sweeps.live_table import status_table
from experiments.system.errors import ConfigError

CAR = ["env=MountainCar", "total_steps=1000"]  # one iteration of 4,096 steps


def test_expand_jobs_values_give_their_product_with_separate_directories():
    found = jobs.expand_jobs([*CAR, "algo=rnd,snd_vic", "seed=0,9", "algo.eta=0.5,1"])
    assert [job.name for job in found] == [
        f"MountainCar/{algo}/{seed},algo.eta={eta}"
        for algo, seed, eta in itertools.product(("rnd", "snd_vic"), (0, 9), ("0.5", "1"))
    ]
    assert found[0].overrides == [*CAR, "algo=rnd", "seed=0", "algo.eta=0.5"]
    assert {(job.total, job.problem) for job in found} == {(4096, None)}


def test_expand_jobs_ranges_and_a_fixed_seed_are_expanded():
    assert [c.name for c in jobs.expand_jobs([*CAR, "algo=ppo", "seed=range(2)"])] == [
        "MountainCar/ppo/0",
        "MountainCar/ppo/1",
    ]
    assert [c.name for c in jobs.expand_jobs([*CAR, "algo=ppo"])] == ["MountainCar/ppo/0"]


def test_expand_jobs_command_line_overrides_the_file():
    assert [c.name for c in jobs.expand_jobs(["seed=0,1,2", *CAR, "algo=ppo", "seed=7"])] == [
        "MountainCar/ppo/7"
    ]


def test_expand_jobs_bad_job_has_a_reason_and_the_others_none():
    found = jobs.expand_jobs(["env=MountainCar,MontainCar", "algo=ppo", "ppo.epochs=2,0"])
    problems = {job.name: job.problem for job in found}
    assert problems["MountainCar/ppo/0,ppo.epochs=2"] is None
    assert "ppo.epochs=0: must be at least 1" in problems["MountainCar/ppo/0,ppo.epochs=0"]
    assert "did you mean MountainCar" in problems["MontainCar/ppo/0,ppo.epochs=2"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["env=MountainCar", "algo=ppo", "run_dir=there"], "hydra.sweep.dir"),
        (["env=MountainCar", "algo=ppo", "ppo.clip=interval(0,1)"], "only a search"),
        (["env=MountainCar", "algo=ppo", "seed=(1"], "cannot read"),
        (["env=envpool", "env.id=A/b-v1,A-b-v1", "algo=ppo"], "2 jobs would all be"),
    ],
)
def test_expand_jobs_bad_input_is_refused(arguments, words):
    with pytest.raises(ConfigError, match=words):
        jobs.expand_jobs(arguments)


def test_job_name_values_with_slashes_stay_inside_the_directory():
    name = jobs.job_name(["env=..", "algo=examples/my_bonus.py:f", "group=../a"], ["group"])
    assert name == "unnamed/f/0,group=..%2Fa"


def left(directory, job, steps, returns, **last):
    """Write a job and the summary of its run."""
    run = directory / job.name
    run.mkdir(parents=True)
    seeds = [{"steps": steps, "last100_ext_return": value} for value in returns]
    (run / "summary.json").write_text(json.dumps({"seeds": seeds}))
    jobs.write_job(directory, job, **last)


def test_job_statuses_are_read_from_the_files_of_the_jobs(tmp_path):
    kinds = ["finished", "failed", "killed", "interrupted", "new", "running", "bad"]
    made = {k: jobs.Job(f"{k}/ppo/0", ["env=x"], 100, None) for k in kinds}
    made["bad"] = made["bad"]._replace(problem="no such thing")
    left(tmp_path, made["finished"], 100, [1.0, 3.0, None], status=0)
    left(tmp_path, made["failed"], 50, [0.5], status=1, reason="seed 0: entropy is nan")
    left(tmp_path, made["killed"], 50, [0.5], pid=1, host="there")
    left(tmp_path, made["interrupted"], 50, [0.5], status=143, reason="interrupted")
    left(tmp_path, made["running"], 50, [0.5], pid=1, host="there")
    for kind in ("new", "bad"):
        jobs.write_job(tmp_path, made[kind])
    log = tmp_path / made["running"].name / "metrics.jsonl"
    log.write_text('{"step": 64, "last100_ext_return": 0.25}\n{"step": 96, "last1')
    with job_status.lock_job(tmp_path, made["running"].name) as own:
        assert own is not None
        with job_status.lock_job(tmp_path, made["running"].name) as again:
            assert again is None
        found = {s.job.name.partition("/")[0]: s[1:] for s in job_status.job_statuses(tmp_path)}
    assert found == {
        "finished": ("done", 100, 2.0, ""),
        "failed": ("failed", 50, 0.5, "seed 0: entropy is nan"),
        "killed": ("stopped", 50, 0.5, ""),
        "interrupted": ("stopped", 50, 0.5, ""),
        "new": ("waiting", 0, None, ""),
        "running": ("running", 64, 0.25, ""),
        "bad": ("failed", 0, None, "no such thing"),
    }
    shown = status_table(job_status.job_statuses(tmp_path)).splitlines()
    assert shown[-1] == "7 jobs: 1 done, 3 stopped, 2 failed, 1 waiting"  # the lock is released


def test_job_statuses_directory_without_a_sweep_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="no sweep here"):
        job_status.job_statuses(tmp_path)
    (tmp_path / "cells").mkdir()
    (tmp_path / "cells" / "x.json").write_text("[1]")
    with pytest.raises(ConfigError, match="describes no job"):
        job_status.job_statuses(tmp_path)
