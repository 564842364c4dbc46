"""python -m experiments.benches [--write]: the benchmark of every algorithm that has figures.

Runs `experiments.bench env=Venture` for each in a process of its own and prints its figures as
ratios to those in docs/results/bench.json, which --write replaces. Shares of the machine's own
matrix product are compared, so that a slower machine is no regression.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from experiments.ledger import ALGORITHMS

FIGURES = Path(__file__).parents[1] / "docs" / "results" / "bench.json"


def bench(name: str) -> dict[str, Any]:
    """The last line of one benchmark."""
    command = [sys.executable, "-m", "experiments.bench", "env=Venture", f"algo={name}"]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def main(arguments: list[str]) -> int:
    """Print a line an algorithm."""
    before = json.loads(FIGURES.read_text()) if FIGURES.exists() else {}
    after: dict[str, Any] = {}
    print(
        f"{'':<9}{'steps/s':>9}{'share of peak':>15}{'to before':>11}{'peak MB':>9}"
        f"{'compile s':>11}",
        flush=True,
    )
    for name in ALGORITHMS:
        found = after[name] = bench(name)
        share = found["share_of_peak"]
        ratio = f"{share / before[name]['share_of_peak']:.2f}" if name in before else "-"
        print(
            f"{name:<9}{found['steps_per_second']:>9.1f}{share:>15.2f}{ratio:>11}"
            f"{found['peak_rss_mb']:>9,.0f}{found['compile_seconds']:>11.0f}",
            flush=True,
        )
    if "--write" in arguments:
        FIGURES.write_text(json.dumps(after, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
