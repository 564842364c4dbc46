"""The state of each job of a sweep, from its run directory, its lock and its last run.

The process that runs a job holds a lock on the job's log; the kernel releases it with the process.
"""

import fcntl
import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from ..storage.read_runs import read_summary
from ..system.errors import ConfigError
from .jobs import Job, job_file, read_jobs

DONE, RUNNING, STOPPED, FAILED, WAITING = STATES = (
    "done",
    "running",
    "stopped",
    "failed",
    "waiting",
)


class JobStatus(NamedTuple):
    """The state of a job."""

    job: Job
    state: str  # one of STATES
    step: int  # steps per seed so far
    last100: float | None  # the mean over seeds of the return of the last 100 episodes
    reason: str  # why it failed, or ""


@contextmanager
def lock_job(directory: Path, name: str, patience: float = 0.0) -> Iterator[int | None]:
    """Lock a job, and yield its open log, or None if another process holds the lock.

    A run whose worker was killed also holds the lock, until it has written its checkpoint.

    Args:
      directory: the directory of the sweep.
      name: the name of the job.
      patience: the seconds to wait for the lock.

    Raises:
      ConfigError: the file system has no locks.
    """
    path = job_file(directory, name, "log")
    path.parent.mkdir(parents=True, exist_ok=True)
    log = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
    end = time.monotonic() + patience
    try:
        while not try_lock(log, fcntl.LOCK_EX):
            if time.monotonic() >= end:
                yield None
                return
            time.sleep(0.5)
        yield log
    finally:
        os.close(log)


def try_lock(file: int, kind: int) -> bool:
    """Lock an open file if its lock is free, and return whether it is now held.

    Raises:
      ConfigError: the file system has no locks.
    """
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        raise ConfigError(
            f"this file system has no locks, and a sweep needs them: {error}"
        ) from None
    return True


def is_locked(directory: Path, name: str) -> bool:
    """Return True if a process runs the job now."""
    try:
        with job_file(directory, name, "log").open() as log:
            return not try_lock(log.fileno(), fcntl.LOCK_SH)
    except FileNotFoundError:
        return False


def job_status(directory: Path, job: Job, last: dict[str, Any]) -> JobStatus:
    """Return the state of a job, from its run directory, its lock and its last run.

    Args:
      directory: the directory of the sweep.
      job: the job.
      last: the recorded data of its last run.
    """
    line = last_metrics_line(directory / job.name / "metrics.jsonl")
    steps, last100 = summary_metric(directory / job.name, "last100_ext_return")
    step = max(steps, int(line.get("step", 0)))
    reason = str(last.get("reason", ""))
    if job.problem is not None:
        return JobStatus(job, FAILED, step, last100, job.problem)
    if steps >= job.total:
        return JobStatus(job, DONE, step, last100, "")
    if is_locked(directory, job.name):
        return JobStatus(job, RUNNING, step, line.get("last100_ext_return"), "")
    if last.get("status") in (None, 0, 130, 143):  # 0: that run had fewer steps to do
        state = STOPPED if step or "pid" in last else WAITING
        return JobStatus(job, state, step, last100, "")
    return JobStatus(job, FAILED, step, last100, reason)


def job_statuses(directory: Path) -> list[JobStatus]:
    """Return the state of every job of a sweep.

    Raises:
      ConfigError: the directory holds no sweep, or the file system has no locks.
    """
    return [job_status(directory, job, last) for job, last in read_jobs(directory)]


def summary_metric(run: Path, name: str) -> tuple[int, float | None]:
    """Return a run's steps per seed, and the mean over seeds of one metric of its summary."""
    try:
        seeds = read_summary(run)
        values = [seed[name] for seed in seeds if seed[name] is not None]
        steps = min((seed["steps"] for seed in seeds), default=0)
        return steps, sum(values) / len(values) if values else None
    except (KeyError, TypeError):
        return 0, None


def last_metrics_line(path: Path, size: int = 1 << 16) -> dict[str, Any]:
    """Return the last complete JSON line of a log, or {} if there is none."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - size))
            lines = file.read().split(b"\n")[:-1]
        return json.loads(lines[-1])
    except (OSError, ValueError, IndexError):
        return {}
