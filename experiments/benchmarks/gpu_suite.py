"""Everything that is to be known on a GPU, each in a child process, within a given time."""

import json
import signal
import subprocess
import time
from contextlib import ExitStack, suppress
from pathlib import Path

from ..config.command_text import option_text
from ..config.validation import unknown_name_error
from ..reporting.run_report import write_report
from ..sweeps.job_runner import memory_sharing_variables
from ..system.errors import ConfigError
from ..system.process import available_cores, enable_compilation_cache
from ..system.subprocesses import run_code, start_command
from ..system.versions import versions
from .gpu_page import read_rows, write_page
from .gpu_steps import STEPS

PATIENCE = 600.0  # seconds that a run may take from the signal to its checkpoint
LEAST_MEASURE = 20.0  # seconds that a measurement gets, however short the suite is
LEAST_SECONDS = 90  # of a round of runs: half of it is compilation


def jax_backend() -> str:
    """Return the name of jax's backend, found by a child process that releases it again."""
    return run_code("import jax; print(jax.default_backend())").stdout.strip()


def wait_for_checkpoint(process: subprocess.Popen[bytes]) -> int:
    """Wait for a run after a SIGTERM; return its exit status, or 0 if the signal ended it."""
    try:
        status = process.wait(PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        status = process.wait()
    return 0 if status in (128 + signal.SIGTERM, -signal.SIGTERM) else status


def train_together(
    pairs: list[tuple[str, str]], out: Path, seconds: float, alone: bool
) -> list[int]:
    """Start or resume runs side by side for some seconds, and return their exit statuses.

    At the end, or if this process is stopped, each run gets a SIGTERM and writes its checkpoint if
    training has started.

    Args:
      pairs: pairs of an environment and an algorithm.
      out: the directory of the runs.
      seconds: the time until the SIGTERM.
      alone: whether one run has the GPU and the terminal; otherwise the runs share the memory of
        the GPU and write to files.
    """
    end, processes = time.monotonic() + seconds, []
    variables = {} if alone else memory_sharing_variables()
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
                with suppress(subprocess.TimeoutExpired):
                    process.wait(max(0.0, end - time.monotonic()))
        finally:
            for process in processes:
                process.terminate()
            statuses = [wait_for_checkpoint(process) for process in processes]
    return statuses


def print_measurement(name: str) -> None:
    """Take a measurement in this process, and print each of its rows as a line of JSON.

    On a CPU it is that of a small task.

    Args:
      name: of the step.

    Raises:
      ConfigError: there is no such step.
    """
    from .gpu_measurements import measure  # imports jax
    from .timing import device_name, print_line

    known = {step.name: step for step in STEPS}
    if name not in known:
        raise unknown_name_error("measurement", name, known)
    enable_compilation_cache()
    import jax

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
        for name in wanted:
            seconds = min(self.left(), max(shares[name] * self.seconds, LEAST_MEASURE))
            if seconds > 1:
                print(f"{name}: at most {seconds:.0f} s", flush=True)
                print(f"{name}: {self.measure(name, seconds)}", flush=True)
                write_page(self.out, self.command)
        try:
            self.train(pairs, at_once)
        finally:
            self.keep_logs()
            write_page(self.out, self.command)
        print(f"page: {self.out / 'suite.md'}", flush=True)

    def measure(self, name: str, seconds: float) -> str:
        """Take one measurement in a child process, and return what became of it.

        Its rows go to its file as they come; what the file had before is replaced by the first.

        Args:
          name: of the step.
          seconds: after which it is stopped.
        """
        fresh, log = self.out / f".{name}.new", self.out / f".{name}.log"
        with fresh.open("wb") as rows, log.open("wb") as errors:
            child = start_command("gpu_suite", [f"measure={name}"], output=rows, errors=errors)
            try:
                status = child.wait(seconds)
            except subprocess.TimeoutExpired:
                status = None
            finally:
                child.kill()
                child.wait()
        lines = [line for line in fresh.read_text().splitlines() if line.startswith("{")]
        fresh.unlink()
        if lines:
            (self.out / f"{name}.jsonl").write_text("\n".join(lines) + "\n")
        said = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
        log.unlink()
        became = f"{len(lines)} row(s)"
        if status is None:
            return f"{became}, stopped after {seconds:.0f} s"
        return became if status == 0 else f"{became}, failed: {said[-1] if said else status}"

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
        share, failed = self.left() / len(rounds), []
        if share < LEAST_SECONDS / 4:
            print("no time is left for the runs", flush=True)
            return
        for together in rounds:
            names = [f"{env} {algo}" for env, algo in together]
            where = "" if at_once == 1 else f"; they write to {self.runs}/*/*.log"
            print(f"{', '.join(names)}: {share / 60:.1f} minutes{where}", flush=True)
            statuses = train_together(together, self.runs, share, at_once == 1)
            pages = zip(names, statuses, strict=True)
            failed += [f"{name} (status {status})" for name, status in pages if status]
        write_report([self.runs], self.runs / "report")
        if failed:
            raise ConfigError(
                f"these runs failed: {', '.join(failed)}; the same command resumes the others"
            )

    def keep_logs(self) -> None:
        """Copy the metrics of every run to the figures, with the rate of each iteration."""
        for path in sorted(self.runs.glob("*/*/metrics.jsonl")):
            rows = read_rows(path)
            times = {row["iteration"]: row for row in read_rows(path.with_name("times.jsonl"))}
            for row in rows:
                row |= times.get(row["iteration"], {})
            name = f"run-{path.parent.parent.name}-{path.parent.name}.jsonl"
            (self.out / name).write_text("".join(json.dumps(row) + "\n" for row in rows))
