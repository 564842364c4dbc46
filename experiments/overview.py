"""One view of a sweep: a table of its cells, kept up to date while they run."""

import threading
import time
from contextlib import suppress
from pathlib import Path

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from experiments import cells
from experiments.cells import Standing
from experiments.progress import clock, number

LOOK_SECONDS = 2  # between two looks at the cells
QUIET_SECONDS = 30  # between two lines, where there is no terminal
COLOURS = dict(zip(cells.STATES, ("green", "cyan", "yellow", "red", "bright_black"), strict=True))


def table(standings: list[Standing]) -> str:
    """The cells and how they stand, as plain lines."""
    width = max((len(s.cell.name) for s in standings), default=4)
    lines = [f"{'cell':<{width}}  {'state':<8}{'steps':>12}{'of':>14}  last-100 return"]
    for s in standings:
        reason = f"  {s.reason}" if s.reason else ""
        lines.append(
            f"{s.cell.name:<{width}}  {s.state:<8}{s.step:>12,}{s.cell.total:>14,}"
            f"  {number(s.last100)}{reason}"
        )
    return "\n".join([*lines, counted(standings)])


def counted(standings: list[Standing]) -> str:
    """How many cells are in each state.

    >>> cell = cells.Cell("Venture/rnd/0", [], 10, None)
    >>> counted([Standing(cell, "done", 10, None, ""), Standing(cell, "waiting", 0, None, "")])
    '2 cells: 1 done, 1 waiting'
    """
    counts = [(sum(s.state == state for s in standings), state) for state in cells.STATES]
    return f"{len(standings)} cells: {', '.join(f'{n} {state}' for n, state in counts if n)}"


class Overview:
    """Looks at a sweep's files in a thread of its own, whichever launcher runs the cells."""

    def __init__(self, directory: Path):
        """Nothing was looked at yet."""
        self.directory = directory
        self.standings: list[Standing] = []
        self.begun = time.monotonic()
        self.first: int | None = None  # steps of all cells when it began
        self.over = threading.Event()
        self.thread = threading.Thread(target=self.watch, daemon=True)
        self.console = Console()
        self.live: Live | None = None

    def __enter__(self) -> "Overview":
        self.look()
        if self.console.is_terminal:
            self.live = Live(self.render(), console=self.console, auto_refresh=False)
            self.live.start()
        self.thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.over.set()
        self.thread.join()
        self.look()
        if self.live is not None:
            self.live.update(Text(""), refresh=True)
            self.live.stop()

    def look(self) -> None:
        """See how the cells stand."""
        with suppress(cells.ConfigError):  # a search has none at first
            self.standings = cells.survey(self.directory)
        if self.first is None:
            self.first = sum(s.step for s in self.standings)

    def watch(self) -> None:
        """Until the sweep is over, show what changed."""
        said = -float("inf")
        while not self.over.wait(LOOK_SECONDS):
            before = {s.cell.name: s.state for s in self.standings}
            with suppress(OSError):  # a file that is replaced while it is read, or nobody to read
                self.look()
                if self.live is not None:
                    self.live.update(self.render(), refresh=True)
                    continue
                for s in self.standings:
                    if before.get(s.cell.name, cells.WAITING) != s.state:
                        more = s.reason or f"last-100 return {number(s.last100)}"
                        print(f"{s.cell.name}: {s.state}, {s.step:,} steps, {more}", flush=True)
                if self.standings and time.monotonic() - said > QUIET_SECONDS:
                    said = time.monotonic()
                    print(self.summary(), flush=True)

    def summary(self) -> str:
        """One line: cells, steps, and the time that is left at the rate so far."""
        done = sum(s.step for s in self.standings)
        total = sum(s.cell.total for s in self.standings if not s.cell.problem)
        gained, gone = done - (self.first or 0), time.monotonic() - self.begun
        left = f", {clock(gone * (total - done) / gained)} left" if gained else ""
        return f"{counted(self.standings)}; {done:,} of {total:,} steps in {clock(gone)}{left}"

    def render(self) -> Group:
        """The display of this moment: the cells that run, and one line of all."""
        shown = Table.grid(padding=(0, 2))
        for s in self.standings:
            if s.state in (cells.RUNNING, cells.FAILED):
                filled = round(20 * s.step / max(s.cell.total, 1))
                bar = Text("━" * filled, "green") + Text("━" * (20 - filled), "bright_black")
                state = Text(s.state, COLOURS[s.state])
                more = s.reason or f"{s.step:,} steps  last-100 return {number(s.last100)}"
                shown.add_row(s.cell.name, state, bar, more)
        return Group(shown, Text(self.summary(), "cyan"))
