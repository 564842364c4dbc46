"""The thesis' hard games on a GPU for as long as there is time."""

import signal
import subprocess
import time
from contextlib import ExitStack, suppress
from pathlib import Path

from ..reporting.run_report import write_report
from ..sweeps.job_runner import memory_sharing_variables
from ..system.errors import ConfigError
from ..system.subprocesses import run_code, start_command

PATIENCE = 600.0  # seconds that a run may take from the signal to its checkpoint


def jax_backend() -> str:
    """Return the name of the backend of jax, asked in a process that then releases it."""
    return run_code("import jax; print(jax.default_backend())").stdout.strip()


def wait_for_checkpoint(process: subprocess.Popen[bytes]) -> int:
    """Wait for a run that was sent a SIGTERM; return its status, 0 if the signal ended it."""
    try:
        status = process.wait(PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        status = process.wait()
    return 0 if status in (128 + signal.SIGTERM, -signal.SIGTERM) else status


def train_together(
    pairs: list[tuple[str, str]], out: Path, seconds: float, alone: bool
) -> list[int]:
    """Train side by side for so many seconds, from where the runs stand; return their statuses.

    Each gets a SIGTERM, also where this process is stopped, and writes its checkpoint if it has
    begun.

    Args:
      pairs: environments and algorithms.
      out: where the runs are.
      seconds: until the SIGTERM.
      alone: one run has the GPU and the terminal; others leave each other memory, and write to
        files.
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
                arguments = [f"env={env}", f"algo={algo}", f"run_dir={run_dir}", "resume=auto"]
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
    """Train everything, each for its share of the time, and write the page.

    Args:
      pairs: environments and algorithms.
      out: where the runs are; called again it resumes them.
      minutes: for all runs together.
      at_once: runs side by side.
      cpu: also where jax sees no GPU.

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
            f"ended by themselves: {', '.join(failed)}; the others continue when called again"
        )
