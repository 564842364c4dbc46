"""Test `job_runner`: the GPUs of a job, and the reason why it failed."""

import pytest

from experiments.sweeps import job_runner as work
from experiments.sweeps.job_runner import JobRunner, failure_reason, visible_gpus


@pytest.mark.parametrize(
    ("shown", "names"),
    [("6,7", ("6", "7")), ("-1", ()), ("", ()), ("GPU-a, GPU-b,-1,0", ("GPU-a", "GPU-b"))],
)
def test_visible_gpus_are_those_that_the_process_may_use(shown, names, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", shown)
    assert visible_gpus() == names


def test_JobRunner_three_jobs_on_two_gpus_share_one(tmp_path, monkeypatch):
    monkeypatch.setattr(work.tempfile, "gettempdir", lambda: str(tmp_path))
    own = JobRunner(str(tmp_path), str(tmp_path), 0, (), 1, ("6", "7"))
    with own.device() as first, own.device() as second, own.device() as third:
        names = [device["CUDA_VISIBLE_DEVICES"] for device in (first, second, third)]
    assert names[:2] == ["6", "7"]
    assert names[2] in ("6", "7")
    for device in (first, second, third):  # else too little memory for the third
        assert device["XLA_PYTHON_CLIENT_PREALLOCATE"] == "false"
    with JobRunner(str(tmp_path), str(tmp_path), 0, (), 1, ()).device() as none:
        assert none == {}


def test_failure_reason_prefers_signal_then_line_of_sndjax_then_last_line():
    assert failure_reason(["step 1", "sndjax: entropy is nan", "and more"], 1) == "entropy is nan"
    assert failure_reason(["Traceback", "KeyError: 3"], 1) == "KeyError: 3"
    assert failure_reason([], 7) == "exit status 7"
    assert failure_reason(["sndjax: fine"], -9) == "killed by SIGKILL"
