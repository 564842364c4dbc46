"""The runner of one job of a sweep: its process, its lock, and the record of its end."""

import itertools
import os
import random
import signal
import subprocess
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException
from omegaconf import DictConfig

from ..config.command_text import option_text
from ..config.overrides import normalize_overrides
from ..system.process import available_cores
from ..system.subprocesses import start_command
from .job_status import lock_job, summary_metric
from .jobs import (
    Job,
    find_conflict,
    job_file,
    job_name,
    make_job,
    parse_sweep,
    read_job,
    split_hydra_arguments,
    write_job,
)

SEARCH_METRIC = (
    "mean_ext_return"  # what a search maximises: it measures how early and how often reward comes
)
STOP_FILE = "stop"  # while this file exists, no job starts, and running jobs are asked to stop
FAILURE_PREFIX = "job"  # the first word of the error message of a failed job
PATIENCE = 60.0  # seconds that a run may take to end after its worker was killed
MEMORY = 3 << 30  # bytes of memory that a run may need (docs/results/speed.md)


class JobFailed(CompactHydraException):
    """The error of a job that did not finish, raised where it ran, for the launcher."""


@dataclass(frozen=True)
class JobRunner:
    """The task function of a launcher: runs one job. It can be sent to a worker process."""

    directory: str
    start: str  # the directory that the sweep was started in
    starter: int  # the id of the process that started the sweep
    swept: tuple[str, ...]  # the keys that a search gives values to
    threads: int
    gpus: tuple[str, ...]  # the GPUs that the jobs share

    def __call__(self, config: DictConfig) -> float | None:
        """Run the job of a Hydra configuration, and return the metric that a search maximises.

        Raises:
          JobFailed: the job did not finish (the message says why), or a search gets no metric.
        """
        directory = Path(self.directory)
        job = self.find_job(directory, config)
        with lock_job(directory, job.name, PATIENCE) as log:
            if log is None:
                raise JobFailed(f"{FAILURE_PREFIX} {job.name}: another process runs it")
            if (directory / STOP_FILE).exists():
                raise JobFailed(
                    f"{FAILURE_PREFIX} {job.name}: not started, the sweep was interrupted"
                )
            if job.problem is None:
                self.run(directory, job, log)
            steps, value = summary_metric(directory / job.name, SEARCH_METRIC)
        if job.problem is not None or steps < job.total:
            raise JobFailed(f"{FAILURE_PREFIX} {job.name}: {job.problem or 'not finished'}")
        if self.swept and value is None:
            raise JobFailed(
                f"{FAILURE_PREFIX} {job.name}: no episode ended, a search has nothing to maximise"
            )
        return value

    def find_job(self, directory: Path, config: DictConfig) -> Job:
        """Return the job to run: a listed job, or the next job of a search."""
        if name := config.get("job"):
            return read_job(job_file(directory, name, "json"))[0]
        given, _ = split_hydra_arguments(HydraConfig.get().overrides.task)
        overrides = normalize_overrides(given)
        GlobalHydra.instance().clear()  # `make_job` composes with a new instance
        job = make_job(job_name(overrides, self.swept), overrides)
        path = job_file(directory, job.name, "json")
        known = read_job(path)[0] if path.exists() else None
        if other := find_conflict(directory, job, known):
            return job._replace(problem=other)
        if summary_metric(directory / job.name, SEARCH_METRIC)[0] < job.total or job.problem:
            write_job(directory, job)
        return job

    def run(self, directory: Path, job: Job, log: int) -> None:
        """Start or resume the job's run, and record its exit status.

        Args:
          directory: the directory of the sweep.
          job: the job to run.
          log: the file descriptor of the job's log, open and locked.

        Raises:
          JobFailed: the run did not finish; the message says why.
        """
        run_dir = directory / job.name
        if summary_metric(run_dir, SEARCH_METRIC)[0] >= job.total:
            return
        arguments = [*job.overrides, option_text("run_dir", run_dir), "resume=auto"]
        if "group" not in parse_sweep(job.overrides):
            arguments.append(option_text("group", directory))
        before = os.fstat(log).st_size
        with self.device() as device:
            with ignore_worker_signals(os.getpid() != self.starter):
                process = start_command(
                    "run",
                    arguments,
                    output=log,
                    cwd=self.start,
                    variables=thread_variables(self.threads) | device,
                )
            write_job(directory, job, pid=process.pid)
            try:
                status = wait_or_stop(process, directory / STOP_FILE)
            except BaseException:  # launchers raise various errors in workers at a time limit
                process.terminate()
                status = process.wait()
                raise
            finally:
                text = job_file(directory, job.name, "log").read_bytes()[before:]
                why = {"reason": failure_reason(text.decode(errors="replace").splitlines(), status)}
                code = 128 - status if status < 0 else status
                write_job(directory, job, status=code, **(why if status else {}))
        if status != 0:
            raise JobFailed(f"{FAILURE_PREFIX} {job.name}: {why['reason']}")

    @contextmanager
    def device(self) -> Iterator[dict[str, str]]:
        """Yield environment variables that show a run one GPU, if possible an unused one."""
        locks = Path(tempfile.gettempdir()) / f"sndjax-gpus-{os.getuid()}"
        for name in self.gpus:
            with lock_job(locks, name) as own:
                if own is not None:
                    yield memory_sharing_variables() | {"CUDA_VISIBLE_DEVICES": name}
                    return
        if self.gpus:
            yield memory_sharing_variables() | {"CUDA_VISIBLE_DEVICES": random.choice(self.gpus)}
        else:
            yield {}


@contextmanager
def ignore_worker_signals(worker: bool) -> Iterator[None]:
    """Return a context in which started processes ignore SIGUSR2 (Slurm's time limit).

    A worker handles that signal itself and lets its run write a checkpoint. From then on a worker
    ignores Ctrl-C in the terminal, which the main process of the sweep handles.
    """
    if not worker or threading.current_thread() is not threading.main_thread():
        yield
        return
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    heard = signal.signal(signal.SIGUSR2, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGUSR2, heard)


def wait_or_stop(process: subprocess.Popen[bytes], stop: Path) -> int:
    """Wait for a run, and return its exit status; send it SIGTERM if the stop file appears."""
    asked = False
    while True:
        with suppress(subprocess.TimeoutExpired):
            return process.wait(1.0)
        if not asked and stop.exists():
            process.terminate()
            asked = True


def failure_reason(lines: list[str], status: int) -> str:
    """Return the reason of a failed run: the last error in its log."""
    if status < 0:
        return f"killed by {signal.Signals(-status).name}"
    own = [line.removeprefix("sndjax: ") for line in lines if line.startswith("sndjax: ")]
    return (own or lines or [f"exit status {status}"])[-1]


def thread_variables(count: int) -> dict[str, str]:
    """Return the environment variables of a process that computes with `count` threads."""
    names = ("PJRT_NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    return dict.fromkeys(names, str(count))


def memory_sharing_variables() -> dict[str, str]:
    """Return the environment variables of a process that shares a GPU's memory with others.

    By default jax reserves three quarters of the memory at its start.
    """
    name = "XLA_PYTHON_CLIENT_PREALLOCATE"
    return {name: os.environ.get(name, "false")}


def visible_gpus() -> tuple[str, ...]:
    """Return the names of the NVIDIA GPUs that this process may use."""
    shown = os.environ.get("CUDA_VISIBLE_DEVICES")
    if shown is None:
        return tuple(str(k) for k, _ in enumerate(Path("/proc/driver/nvidia/gpus").glob("*")))
    names = [name.strip() for name in shown.split(",")]
    return tuple(itertools.takewhile(lambda name: name not in ("", "-1"), names))


def launcher_resources(launcher: DictConfig, gpus: Sequence[str]) -> tuple[list[str], int]:
    """Return more options for a launcher, and the number of threads of each job."""
    cores = available_cores()
    if "n_jobs" in launcher:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        fitting = len(gpus) or max(1, min(cores, memory // MEMORY))
        jobs = launcher.n_jobs if launcher.n_jobs > 0 else fitting
        return [f"hydra.launcher.n_jobs={jobs}"], max(1, cores // jobs)
    if "ray" in launcher:
        return [], int(launcher.ray.remote.get("num_cpus") or 1)
    return [], int(launcher.get("cpus_per_task") or cores)
