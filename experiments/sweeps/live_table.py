"""A live table of the jobs of a sweep, updated while they run."""

import threading
import time
from contextlib import suppress
from pathlib import Path

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from ..system.display import format_duration, format_number
from ..system.errors import ConfigError
from .job_status import FAILED, RUNNING, STATES, WAITING, JobStatus, job_statuses

LOOK_SECONDS = 2  # between two reads of the state of the jobs
QUIET_SECONDS = 30  # between two summary lines if there is no terminal
COLOURS = dict(zip(STATES, ("green", "cyan", "yellow", "red", "bright_black"), strict=True))


def status_table(statuses: list[JobStatus]) -> str:
    """Format the jobs and their states as lines of text."""
    width = max((len(s.job.name) for s in statuses), default=4)
    lines = [f"{'job':<{width}}  {'state':<8}{'steps':>12}{'of':>14}  last-100 return"]
    for s in statuses:
        reason = f"  {s.reason}" if s.reason else ""
        lines.append(
            f"{s.job.name:<{width}}  {s.state:<8}{s.step:>12,}{s.job.total:>14,}"
            f"  {format_number(s.last100)}{reason}"
        )
    return "\n".join([*lines, count_states(statuses)])


def count_states(statuses: list[JobStatus]) -> str:
    """Format the number of jobs in each state.

    >>> from experiments.sweeps.jobs import Job
    >>> job = Job("Venture/rnd/0", [], 10, None)
    >>> count_states([JobStatus(job, "done", 10, None, ""), JobStatus(job, "waiting", 0, None, "")])
    '2 jobs: 1 done, 1 waiting'
    """
    counts = [(sum(s.state == state for s in statuses), state) for state in STATES]
    return f"{len(statuses)} jobs: {', '.join(f'{n} {state}' for n, state in counts if n)}"


class LiveTable:
    """The live display of a sweep's jobs; a background thread reads their files."""

    def __init__(self, directory: Path):
        """Create the display; the jobs are not read yet."""
        self.directory = directory
        self.statuses: list[JobStatus] = []
        self.begun = time.monotonic()
        self.first: int | None = None  # steps of all jobs at the first read
        self.over = threading.Event()
        self.thread = threading.Thread(target=self.watch, daemon=True)
        self.console = Console()
        self.live: Live | None = None

    def __enter__(self) -> "LiveTable":
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
        """Read the state of every job."""
        with suppress(ConfigError):  # a search has no jobs at first
            self.statuses = job_statuses(self.directory)
        if self.first is None:
            self.first = sum(s.step for s in self.statuses)

    def watch(self) -> None:
        """Show the changes of the jobs until the sweep ends."""
        said = -float("inf")
        while not self.over.wait(LOOK_SECONDS):
            before = {s.job.name: s.state for s in self.statuses}
            with suppress(OSError):  # a file was replaced during the read, or the output is closed
                self.look()
                if self.live is not None:
                    self.live.update(self.render(), refresh=True)
                    continue
                for s in self.statuses:
                    if before.get(s.job.name, WAITING) != s.state:
                        more = s.reason or f"last-100 return {format_number(s.last100)}"
                        print(f"{s.job.name}: {s.state}, {s.step:,} steps, {more}", flush=True)
                if self.statuses and time.monotonic() - said > QUIET_SECONDS:
                    said = time.monotonic()
                    print(self.summary(), flush=True)

    def summary(self) -> str:
        """Format one line: jobs, steps, and the time left at the average rate so far."""
        done = sum(s.step for s in self.statuses)
        total = sum(s.job.total for s in self.statuses if not s.job.problem)
        gained, gone = done - (self.first or 0), time.monotonic() - self.begun
        left = f", {format_duration(gone * (total - done) / gained)} left" if gained else ""
        steps = f"{done:,} of {total:,} steps in {format_duration(gone)}"
        return f"{count_states(self.statuses)}; {steps}{left}"

    def render(self) -> Group:
        """Return the current display: the running and failed jobs, and one summary line."""
        shown = Table.grid(padding=(0, 2))
        for s in self.statuses:
            if s.state in (RUNNING, FAILED):
                filled = round(20 * s.step / max(s.job.total, 1))
                bar = Text("━" * filled, "green") + Text("━" * (20 - filled), "bright_black")
                state = Text(s.state, COLOURS[s.state])
                more = s.reason or f"{s.step:,} steps  last-100 return {format_number(s.last100)}"
                shown.add_row(s.job.name, state, bar, more)
        return Group(shown, Text(self.summary(), "cyan"))
