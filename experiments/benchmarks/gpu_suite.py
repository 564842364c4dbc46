"""Everything that is to be known on a GPU, each in a child process, within a given time."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path

from ..config.command_text import option_text
from ..config.validation import unknown_name_error
from ..reporting.run_report import write_report
from ..sweeps.job_runner import memory_sharing_variables
from ..system.errors import ConfigError
from ..system.files import write_atomically
from ..system.process import available_cores, enable_compilation_cache
from ..system.subprocesses import run_code, start_command
from ..system.versions import versions
from .gpu_page import PAGE, read_rows, write_page
from .gpu_steps import STEPS

STOP_SECONDS = 30.0  # that runs may take from the signal to their checkpoints
LOOK_SECONDS = 10.0  # between two looks at the logs of runs
LEAST_MEASURE = 20.0  # seconds that a measurement gets, however short the suite is
LEAST_SECONDS = 90  # of a round of runs: half of it is compilation


def jax_backend() -> str:
    """Return the name of jax's backend, found by a child process that releases it again."""
    return run_code("import jax; print(jax.default_backend())").stdout.strip()


def wait_for_checkpoint(process: subprocess.Popen[bytes], patience: float) -> int:
    """Wait for a run after a SIGTERM; return its exit status, or 0 if the signal ended it.

    Args:
      process: the run.
      patience: the seconds until it is killed.
    """
    try:
        status = process.wait(patience)
    except subprocess.TimeoutExpired:
        process.kill()
        status = process.wait()
    return 0 if status in (128 + signal.SIGTERM, -signal.SIGTERM) else status


def one_gpu() -> dict[str, str]:
    """Return the environment variable that shows a child process the first GPU alone."""
    name = "CUDA_VISIBLE_DEVICES"
    return {name: os.environ.get(name, "0").partition(",")[0]}


def train_together(
    pairs: list[tuple[str, str]],
    out: Path,
    seconds: float,
    alone: bool,
    patience: float = STOP_SECONDS,
    meanwhile: Callable[[], None] = lambda: None,
) -> list[int]:
    """Start or resume runs side by side for some seconds, and return their exit statuses.

    At the end, or if this process is stopped, each run gets a SIGTERM and writes its checkpoint if
    training has started.

    Args:
      pairs: pairs of an environment and an algorithm.
      out: the directory of the runs.
      seconds: the time until the SIGTERM.
      alone: whether one run has the GPU and the terminal; otherwise the runs share the memory of
        the GPU and the cores, and write to files.
      patience: the seconds that they may take to stop.
      meanwhile: called every `LOOK_SECONDS`.
    """
    end, processes = time.monotonic() + seconds, []
    variables = one_gpu()
    if not alone:
        share = max(1, available_cores() // len(pairs))
        variables |= memory_sharing_variables() | {"PJRT_NPROC": str(share)}
    with ExitStack() as files:
        try:
            for env, algo in pairs:
                run_dir, output = out / env / algo, None
                if not alone:
                    run_dir.parent.mkdir(parents=True, exist_ok=True)
                    output = files.enter_context(run_dir.with_suffix(".log").open("ab"))
                arguments = [f"env={env}", f"algo={algo}", "resume=auto"]
                arguments.append(option_text("run_dir", run_dir))
                processes.append(
                    start_command("run", arguments, output=output, variables=variables)
                )
            for process in processes:
                while process.poll() is None and time.monotonic() < end:
                    with suppress(subprocess.TimeoutExpired):
                        process.wait(min(LOOK_SECONDS, max(0.0, end - time.monotonic())))
                    meanwhile()
        finally:
            for process in processes:
                process.terminate()
            last = time.monotonic() + patience
            statuses = [
                wait_for_checkpoint(process, max(1.0, last - time.monotonic()))
                for process in processes
            ]
    return statuses


def print_measurement(name: str) -> None:
    """Take a measurement in this process, and print each of its rows as a line of JSON.

    On a CPU it is that of a small task.

    Args:
      name: of the step.

    Raises:
      ConfigError: there is no such step.
    """
    known = {step.name: step for step in STEPS}
    if name not in known:
        raise unknown_name_error("measurement", name, known)
    import jax

    from .gpu_measurements import measure
    from .timing import device_name, print_line

    enable_compilation_cache()
    toy = jax.default_backend() == "cpu"
    for row in measure(known[name], toy):
        where = {"device": device_name(), "cores": available_cores(), "versions": versions()}
        print_line(json.dumps(row | where | {"small": toy}))


class Suite:
    """Everything that is to be known on a GPU, within a given time."""

    def __init__(self, out: Path, runs: Path, minutes: float, cpu: bool):
        """Start the clock.

        Args:
          out: where the figures and the page go.
          runs: where the runs of the last step are; runs that are there are resumed.
          minutes: the time of everything together.
          cpu: whether to go on even if jax sees no GPU.

        Raises:
          ConfigError: there is no GPU.
        """
        if not cpu and jax_backend() != "gpu":
            raise ConfigError(
                "jax sees no GPU here: not run (pip install 'sndjax[cuda]' if there is one; "
                "--cpu to run small tasks all the same)"
            )
        self.out, self.runs, self.seconds = out, runs, 60 * minutes
        self.end = time.monotonic() + self.seconds
        self.command = f"sndjax gpu_suite minutes={minutes:g}"

    def left(self) -> float:
        """Return the seconds that are left."""
        return max(0.0, self.end - time.monotonic())

    def run(self, steps: str, pairs: list[tuple[str, str]], at_once: int) -> None:
        """Take the measurements, train for the rest of the time, and write the page.

        Args:
          steps: names of measurements with commas; all or none.
          pairs: of an environment and an algorithm, to train for the rest of the time.
          at_once: the number of runs side by side.

        Raises:
          ConfigError: a measurement does not exist, or runs failed.
        """
        wanted = [step.name for step in STEPS] if steps == "all" else steps.split(",")
        shares = {step.name: step.share for step in STEPS}
        if steps == "none":
            wanted = []
        for name in wanted:
            if name not in shares:
                raise unknown_name_error("measurement", name, shares)
        self.out.mkdir(parents=True, exist_ok=True)
        before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
        try:
            for name in wanted:
                seconds = min(self.left(), max(shares[name] * self.seconds, LEAST_MEASURE))
                if seconds > 1:
                    print(f"{name}: at most {seconds:.0f} s", flush=True)
                    print(f"{name}: {self.measure(name, seconds)}", flush=True)
                    write_page(self.out, self.command)
            self.train(pairs, at_once)
        finally:
            signal.signal(signal.SIGTERM, before)
            self.keep_logs()
        print(f"page: {self.out / PAGE}", flush=True)

    def measure(self, name: str, seconds: float) -> str:
        """Take one measurement in a child process, and return what became of it.

        A row is in the file of the step as soon as it comes; the first replaces what was there.

        Args:
          name: of the step.
          seconds: after which it is stopped.
        """
        rows, path = 0, self.out / f"{name}.jsonl"
        end = time.monotonic() + seconds
        with tempfile.TemporaryFile() as errors:
            child = start_command(
                "gpu_suite",
                [f"measure={name}"],
                output=subprocess.PIPE,
                errors=errors,
                variables=one_gpu(),
            )
            assert child.stdout is not None
            timer = threading.Timer(seconds, child.kill)
            timer.start()
            try:
                for line in child.stdout:
                    if line.startswith(b"{"):
                        with path.open("ab" if rows else "wb") as file:
                            file.write(line)
                        rows += 1
                status = child.wait()
            finally:
                timer.cancel()
                child.kill()
                child.wait()
            errors.seek(0)
            lines = [one for one in errors.read().decode(errors="replace").splitlines() if one]
            said = lines[-1] if lines else f"status {status}"
        became = f"{rows} row(s)"
        if status == 0:
            return became
        if time.monotonic() >= end:
            return f"{became}, stopped after {seconds:.0f} s"
        return f"{became}, failed: {said}"

    def train(self, pairs: list[tuple[str, str]], at_once: int) -> None:
        """Train for the rest of the time: as many rounds as can have `LEAST_SECONDS`.

        Args:
          pairs: of an environment and an algorithm.
          at_once: the number of runs side by side.

        Raises:
          ConfigError: runs failed.
        """
        rounds = [pairs[k : k + at_once] for k in range(0, len(pairs), at_once)]
        rounds = rounds[: max(1, int(self.left() / LEAST_SECONDS))]
        stopping = min(STOP_SECONDS, self.left() / 10)  # of each round, and for the pages
        share, failed = self.left() / len(rounds) - stopping, []
        if share < LEAST_SECONDS / 5:
            print("no time is left for the runs", flush=True)
            return
        for together in rounds:
            names = [f"{env} {algo}" for env, algo in together]
            where = "" if at_once == 1 else f"; they write to {self.runs}/*/*.log"
            print(f"{', '.join(names)}: {share / 60:.1f} minutes{where}", flush=True)
            statuses = train_together(
                together, self.runs, share, at_once == 1, max(stopping, 10.0), self.keep_logs
            )
            pages = zip(names, statuses, strict=True)
            failed += [f"{name} (status {status})" for name, status in pages if status]
            self.keep_logs()
        write_report([self.runs], self.runs / "report")
        for picture in (self.runs / "report").glob("*-return.png"):
            shutil.copyfile(picture, self.out / picture.name)
        if failed:
            raise ConfigError(
                f"these runs failed: {', '.join(failed)}; the same command resumes the others"
            )

    def keep_logs(self) -> None:
        """Copy the metrics of every run to the figures, with its rates, and write the page."""
        for path in sorted(self.runs.glob("*/*/metrics.jsonl")):
            rows = read_rows(path)
            times = {row["iteration"]: row for row in read_rows(path.with_name("times.jsonl"))}
            lines = [json.dumps(row | times.get(row["iteration"], {})) + "\n" for row in rows]
            name = f"run-{path.parent.parent.name}-{path.parent.name}.jsonl"
            write_atomically(self.out / name, "".join(lines))
        write_page(self.out, self.command)
