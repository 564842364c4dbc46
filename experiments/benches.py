"""python -m experiments.benches [NAME ...] [--write]: the benchmark of each algorithm.

Runs `experiments.bench env=Venture` for each in a process of its own (where there is a GPU also
with four seeds at once) and prints its figures as ratios to those in docs/results/, in
bench-cpu.json or bench-gpu.json, which --write replaces. Shares of the machine's own matrix
product are compared, so that a slower machine is no regression.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from experiments.ledger import ALGORITHMS

RESULTS = Path(__file__).parents[1] / "docs" / "results"


def bench(*options: str) -> dict[str, Any]:
    """The last line of one benchmark."""
    command = [sys.executable, "-m", "experiments.bench", "env=Venture", *options]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def figures(platform: str) -> Path:
    """Where the figures of a kind of device are kept."""
    return RESULTS / f"bench-{platform}.json"


def main(arguments: list[str]) -> int:
    """Print a line a benchmark."""
    if {"-h", "--help"} & set(arguments):
        print(__doc__)
        return 0
    names = [argument for argument in arguments if argument != "--write"] or ALGORITHMS
    if unknown := set(names) - set(ALGORITHMS):
        print(f"sndjax: no figures of {', '.join(unknown)}; there is {', '.join(ALGORITHMS)}")
        return 2
    print(
        f"{'':<20}{'steps/s':>9}{'share of peak':>15}{'to before':>11}{'peak MB':>9}"
        f"{'compile s':>11}",
        flush=True,
    )
    left: list[tuple[str, ...]] = [(f"algo={name}",) for name in names]
    before: dict[str, Any] = {}
    after: dict[str, Any] = {}
    while left:
        options = left.pop(0)
        name = " ".join(options).removeprefix("algo=")
        found = bench(*options)
        if not after:
            path = figures(found["platform"])
            before = json.loads(path.read_text()) if path.exists() else {}
            if found["platform"] != "cpu":
                left.append(("algo=snd_std", "num_seeds=4"))
        after[name] = found
        share = found["share_of_peak"]
        ratio = f"{share / before[name]['share_of_peak']:.2f}" if name in before else "-"
        print(
            f"{name:<20}{found['steps_per_second']:>9.1f}{share:>15.2f}{ratio:>11}"
            f"{found['peak_rss_mb']:>9,.0f}{found['compile_seconds']:>11.0f}",
            flush=True,
        )
    if "--write" in arguments:
        path.write_text(json.dumps(before | after, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
