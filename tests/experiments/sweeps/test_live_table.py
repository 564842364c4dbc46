"""The view of a sweep: it prints what changed."""

import json
import time

from experiments.sweeps import job_status, jobs
from experiments.sweeps import live_table as overview
from experiments.sweeps.live_table import LiveTable


def test_LiveTable_changes_are_printed_with_reason_and_progress(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(overview, "LOOK_SECONDS", 0.05)
    monkeypatch.setattr(overview, "QUIET_SECONDS", 0.1)
    one, two = (jobs.Job(f"Venture/rnd/{seed}", [], 100, None) for seed in (0, 1))
    for job in (one, two):
        jobs.write_job(tmp_path, job)
    with LiveTable(tmp_path):
        with job_status.lock_job(tmp_path, one.name):
            time.sleep(0.3)
        (tmp_path / one.name).mkdir(parents=True)
        seeds = [{"steps": 100, "last100_ext_return": 0.5}]
        (tmp_path / one.name / "summary.json").write_text(json.dumps({"seeds": seeds}))
        jobs.write_job(tmp_path, two, status=1, reason="entropy is nan")
        time.sleep(0.3)
    lines = capsys.readouterr().out.splitlines()
    assert "Venture/rnd/0: running, 0 steps, last-100 return -" in lines
    assert "Venture/rnd/0: done, 100 steps, last-100 return 0.5" in lines
    assert "Venture/rnd/1: failed, 0 steps, entropy is nan" in lines
    assert any("2 jobs: 1 done, 1 failed; 100 of 200 steps in 0:0" in line for line in lines)
