"""Write one page about runs, finished or not: sndjax report runs/ --out report

The page shows learning curves, the thesis' tables with our numbers beside the published ones, and
statistics over seeds. Symbolic links to runs are followed. Writes one self-contained HTML file, and
each part as PNG, SVG and CSV. With --live the page is written again every half minute, and it
reloads itself.
"""

import time
from dataclasses import dataclass
from pathlib import Path

from .config.option import option
from .config.tool_options import run_command
from .system.errors import ConfigError
from .system.process import run_script


@dataclass(frozen=True)
class Options:
    """The options of the command."""

    out: str = option("report", "where the page goes")
    live: bool = option(False, "write it again every half minute, until Ctrl-C")


def report(paths: list[Path], options: Options) -> None:
    """Write the page, once or until Ctrl-C.

    Raises:
      ConfigError: no directory is given, or there is nothing to show.
    """
    if not paths:
        raise ConfigError("give the directories: sndjax report runs/")
    from .reporting.run_report import REFRESH_SECONDS, write_report
    from .storage.read_runs import RunReader

    out, reader = Path(options.out), RunReader()
    while options.live:
        try:
            write_report(paths, out, live=True, reader=reader)
        except ConfigError as error:  # no runs yet
            print(error, flush=True)
        time.sleep(REFRESH_SECONDS)
    write_report(paths, out)


def main(arguments: list[str]) -> int:
    """Run the command, and return its exit status."""
    return run_command(__doc__, Options, report, arguments)


if __name__ == "__main__":
    run_script(main)
