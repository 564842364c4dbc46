"""python -m experiments.evidence --minutes 240: the thesis' hard games, while there is time.

Trains SND-VIC, SND-STD, RND and PPO on Montezuma's Revenge and Venture at the thesis' settings in
turn, each for its share of the minutes, and stops it at a checkpoint. Called again it goes on
where the runs stand. Leaves a run directory for each, and a page of them all.
"""

import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from experiments.arguments import command
from experiments.options import ConfigError, option

PATIENCE = 600.0  # seconds that a run may take from the signal to its checkpoint


@dataclass(frozen=True)
class Options:
    """What can be chosen."""

    minutes: float = option(60.0, "for all runs together, compilation too", above=0)
    out: str = option("runs/evidence", "where the runs are; called again it goes on there")
    envs: str = option("MontezumaRevenge,Venture", "environments, with commas")
    algos: str = option("snd_vic,snd_std,rnd,ppo", "algorithms, with commas")
    cpu: bool = option(False, "also where jax sees no GPU")


def backend() -> str:
    """What jax computes on, asked in a process that then lets go of it."""
    code = "import jax; print(jax.default_backend())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    return done.stdout.strip()


def train(env: str, algo: str, place: Path, seconds: float) -> int:
    """Train for so many seconds, from where the run stands; 0, or the status it ended with.

    The run gets a SIGTERM, also where this process is stopped, and writes its checkpoint.
    """
    command = [sys.executable, "-m", "experiments.run", f"env={env}", f"algo={algo}"]
    command += [f"run_dir={place}", "resume=auto"]
    if shutil.which("setpriv"):
        command = ["setpriv", "--pdeathsig", "TERM", *command]
    process = subprocess.Popen(command, start_new_session=True)  # Ctrl-C is for us
    try:
        with suppress(subprocess.TimeoutExpired):
            process.wait(seconds)
    finally:
        process.terminate()
        try:
            status = process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            status = process.wait()
    return 0 if status == 128 + signal.SIGTERM else status


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
    out, share = Path(options.out), 60 * options.minutes / len(cells)
    failed = []
    for env, algo in cells:
        print(f"{env} {algo}: {share / 60:.1f} minutes", flush=True)
        status = train(env, algo, out / env / algo, share)
        if status:
            failed.append(f"{env} {algo} (status {status})")
    from experiments.report import write

    page = out / "report"
    page.mkdir(exist_ok=True)
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
