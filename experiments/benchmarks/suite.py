"""The benchmark of each algorithm, compared with the committed figures."""

import json
from pathlib import Path
from typing import Any

from ..system.errors import ConfigError
from ..system.subprocesses import ROOT, run_command_line
from .compiled_cost import ALGORITHMS

RESULTS = ROOT / "docs" / "results"


def run_bench(*options: str) -> dict[str, Any]:
    """Run one benchmark in a separate process, and return its figures.

    Raises:
      subprocess.CalledProcessError: the benchmark failed.
    """
    done = run_command_line("bench", "env=Venture", *options, captured=True)
    done.check_returncode()
    return json.loads(done.stdout.splitlines()[-1])


def results_file(platform: str) -> Path:
    """Return the file with the committed figures of a platform."""
    return RESULTS / f"bench-{platform}.json"


def print_suite(names: list[str], write: bool) -> None:
    """Run each benchmark in a separate process, and print a line for each.

    Args:
      names: the names of the algorithms.
      write: whether to replace the committed figures.

    Raises:
      ConfigError: a name is not one of `ALGORITHMS`.
    """
    if unknown := set(names) - set(ALGORITHMS):
        raise ConfigError(
            f"no figures of {', '.join(sorted(unknown))}: write some of {', '.join(ALGORITHMS)}"
        )
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
        found = run_bench(*options)
        if not after:
            path = results_file(found["platform"])
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
    if write:
        path.write_text(json.dumps(before | after, indent=1) + "\n")
