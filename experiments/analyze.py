"""Compare the feature spaces of trained modules (section 5.4): sndjax analyze RUN_DIR...

Collects states with one agent (or uses the recorded trajectory through Montezuma's Revenge),
encodes them with the module of every run, and draws Fig. 5.7 to 5.10 with the rows of Tables 5.9
and 5.10. Writes one page, and each part as PNG, SVG and CSV.
"""

from dataclasses import dataclass
from pathlib import Path

from .config.option import option
from .config.tool_options import TRUST, run_command
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The options of the command."""

    states: int = option(10_000, "to collect", low=100, high=1_000_000)
    trajectory: bool = option(False, "use the recorded trajectory instead of an agent's states")
    agent: str | None = option(None, "the run whose agent collects; default: the best of them")
    seed: int = option(0, "of the environments and of t-SNE", low=0, high=2**31 - 1)
    out: str = option("analysis", "where the page goes")
    trust: tuple[str, ...] = option((), TRUST)


def analyze(runs: list[Path], options: Options) -> None:
    """Write the page about the feature spaces of the runs."""
    from .analysis.feature_report import check_runs, write_feature_report

    agent = None if options.agent is None else Path(options.agent)
    check_runs(runs, options.trajectory, agent)
    page = write_feature_report(
        runs,
        options.states,
        options.trajectory,
        agent,
        options.seed,
        Path(options.out),
        options.trust,
    )
    print(f"page: {page.resolve()}")


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, analyze, arguments)


if __name__ == "__main__":
    run_script(main)
