"""Training of the thesis' hard games on a GPU for a given time."""

import signal
import subprocess
import time
from contextlib import ExitStack, suppress
from pathlib import Path

from ..config.command_text import option_text
from ..reporting.run_report import write_report
from ..sweeps.job_runner import memory_sharing_variables
from ..system.errors import ConfigError
from ..system.subprocesses import run_code, start_command

PATIENCE = 600.0  # seconds that a run may take from the signal to its checkpoint


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


def run_suite(
    pairs: list[tuple[str, str]], out: Path, minutes: float, at_once: int, cpu: bool
) -> None:
    """Train every run for its share of the time, and write the page.

    Args:
      pairs: pairs of an environment and an algorithm.
      out: the directory of the runs; runs that are already there are resumed.
      minutes: the time of all runs together.
      at_once: the number of runs side by side.
      cpu: whether to train even if jax sees no GPU.

    Raises:
      ConfigError: there is no GPU, or runs failed.
    """
    if not cpu and jax_backend() != "gpu":
        raise ConfigError(
            "jax sees no GPU here: not run (.venv/bin/pip install 'jax[cuda12]' if there is one; "
            "--cpu to run it all the same)"
        )
    rounds = [pairs[k : k + at_once] for k in range(0, len(pairs), at_once)]
    share, alone, failed = 60 * minutes / len(rounds), at_once == 1, []
    for together in rounds:
        names = [f"{env} {algo}" for env, algo in together]
        where = "" if alone else f"; they write to {out}/*/*.log"
        print(f"{', '.join(names)}: {share / 60:.1f} minutes{where}", flush=True)
        statuses = zip(names, train_together(together, out, share, alone), strict=True)
        failed += [f"{name} (status {status})" for name, status in statuses if status]
    write_report([out], out / "report")
    if failed:
        raise ConfigError(
            f"these runs failed: {', '.join(failed)}; the same command resumes the others"
        )
