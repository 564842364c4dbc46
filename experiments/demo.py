"""`make demo`: what a novelty bonus changes, in seconds, with a picture of it."""

import json
import secrets
import subprocess
import sys
import time
from pathlib import Path

ALGORITHMS = ("ppo", "snd_vic")
SEEDS = 3
STEPS = 1_000_000


def main() -> int:
    """Train every algorithm on MountainCar and draw their learning curves together."""
    root = Path("runs") / "demo" / f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(2)}"
    runs = {algo: root / algo for algo in ALGORITHMS}
    print("MountainCar, reward 1 at the goal and 0 elsewhere: does it ever get there?")
    for algo, run in runs.items():
        command = [sys.executable, "-m", "experiments.run", "env=MountainCar", f"algo={algo}"]
        command += [f"num_seeds={SEEDS}", f"total_steps={STEPS}", f"run_dir={run}"]
        print(f"\n$ {' '.join(['python', *command[1:]])}", flush=True)
        status = subprocess.run(command, check=False).returncode
        if status:
            return status
    from experiments.curves import draw
    from experiments.finished import find, grouped

    groups = grouped(find([root])[0])
    title = "MountainCar, reward only at the goal"
    picture = draw(groups, "last100", title, root, "curves")
    assert picture is not None
    print()
    for algo, run in runs.items():
        seeds = json.loads((run / "summary.json").read_text())["seeds"]
        shares = ", ".join(f"{seed['last100_ext_return']:.0%}" for seed in seeds)
        print(f"{algo:<8} last 100 episodes that reach the goal, by seed: {shares}")
    print(f"\npicture: {picture.resolve()}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
