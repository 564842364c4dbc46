"""One seed of the table in docs/results/explores.md, trained anew."""

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_snd_vic_reaches_the_goal_of_mountain_car_as_in_the_table(tmp_path):
    command = [sys.executable, "-m", "experiments.run", "-m", "sweep=small", "algo=snd_vic"]
    command += ["seed=0", f"hydra.sweep.dir={tmp_path / 'sweep'}", "hydra.launcher.n_jobs=2"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    (summary,) = (tmp_path / "sweep").rglob("summary.json")
    (found,) = json.loads(summary.read_text())["seeds"]
    assert found["steps"] == 1_003_520
    assert found["last100_ext_return"] >= 0.9  # 1.00 in the table
