"""python -m experiments.evidence --minutes 240: the thesis' hard games, while there is time.

Trains SND-VIC, SND-STD, RND and PPO on Montezuma's Revenge and Venture at the thesis' settings,
--at-once of them side by side, each for its share of the minutes, and stops it at a checkpoint.
Called again it goes on where the runs stand. Leaves a run directory for each, and a page of them
all.
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

from experiments.arguments import command
from experiments.options import ConfigError, option
from experiments.work import sharing

PATIENCE = 600.0  # seconds that a run may take from the signal to its checkpoint


@dataclass(frozen=True)
class Options:
    """What can be chosen."""

    minutes: float = option(60.0, "for all runs together, compilation too", above=0)
    out: str = option("runs/evidence", "where the runs are; called again it goes on there")
    envs: str = option("MontezumaRevenge,Venture", "environments, with commas")
    algos: str = option("snd_vic,snd_std,rnd,ppo", "algorithms, with commas")
    at_once: int = option(
        1, "runs side by side on the GPU; each then says what it does in a file", low=1
    )
    cpu: bool = option(False, "also where jax sees no GPU")


def backend() -> str:
    """What jax computes on, asked in a process that then lets go of it."""
    code = "import jax; print(jax.default_backend())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    return done.stdout.strip()


def ended(process: subprocess.Popen[bytes]) -> int:
    """The status of a run that was sent a SIGTERM; 0 if that ended it."""
    try:
        status = process.wait(PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        status = process.wait()
    return 0 if status in (128 + signal.SIGTERM, -signal.SIGTERM) else status


def train(cells: list[tuple[str, str]], out: Path, seconds: float, alone: bool) -> list[int]:
    """Train side by side for so many seconds, from where the runs stand; their statuses.

    Each gets a SIGTERM, also where this process is stopped, and writes its checkpoint if it has
    begun. Where a run is not alone on the GPU, it leaves others memory and the terminal.
    """
    end, processes = time.monotonic() + seconds, []
    environment = os.environ | ({} if alone else sharing())
    with ExitStack() as files:
        try:
            for env, algo in cells:
                place = out / env / algo
                command = [sys.executable, "-m", "experiments.run", f"env={env}", f"algo={algo}"]
                command += [f"run_dir={place}", "resume=auto"]
                if shutil.which("setpriv"):
                    command = ["setpriv", "--pdeathsig", "TERM", *command]
                said = None
                if not alone:
                    place.parent.mkdir(parents=True, exist_ok=True)
                    said = files.enter_context(place.with_suffix(".log").open("ab"))
                processes.append(  # a session of its own: Ctrl-C is for us
                    subprocess.Popen(
                        command, start_new_session=True, env=environment, stdout=said, stderr=said
                    )
                )
            for process in processes:
                with suppress(subprocess.TimeoutExpired):
                    process.wait(max(0.0, end - time.monotonic()))
        finally:
            for process in processes:
                process.terminate()
            statuses = [ended(process) for process in processes]
    return statuses


def work(places: list[Path], options: Options) -> None:
    """Train everything, each for its share of the time, and write the page."""
    if places:
        raise ConfigError(f"unexpected {places[0]}; the runs go to --out")
    if not options.cpu and backend() != "gpu":
        raise ConfigError(
            "jax sees no GPU here: not run (.venv/bin/pip install 'jax[cuda12]' if there is one; "
            "--cpu to run it all the same)"
        )
    cells = [(env, algo) for env in options.envs.split(",") for algo in options.algos.split(",")]
    rounds = [cells[k : k + options.at_once] for k in range(0, len(cells), options.at_once)]
    out, share = Path(options.out), 60 * options.minutes / len(rounds)
    alone, failed = options.at_once == 1, []
    for together in rounds:
        names = [f"{env} {algo}" for env, algo in together]
        where = "" if alone else f"; they write to {out}/*/*.log"
        print(f"{', '.join(names)}: {share / 60:.1f} minutes{where}", flush=True)
        statuses = zip(names, train(together, out, share, alone), strict=True)
        failed += [f"{name} (status {status})" for name, status in statuses if status]
    from experiments.report import write

    page = out / "report"
    page.mkdir(parents=True, exist_ok=True)
    write([out], page, live=False)
    if failed:
        raise ConfigError(
            f"ended by themselves: {', '.join(failed)}; the others go on when called again"
        )


def main(arguments: list[str]) -> int:
    """The command."""
    return command(str(__doc__), Options, work, arguments, needs_places=False)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
