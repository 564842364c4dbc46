"""Progress output: a live display on a terminal, plain lines otherwise."""

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any, TypeVar

from rich import progress
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

T = TypeVar("T")
QUIET_SECONDS = 10  # seconds between two lines of one task, without a terminal


def format_duration(seconds: float) -> str:
    """Format a duration as minutes:seconds or hours:minutes:seconds."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"


def format_number(value: float | None, form: str = ".3g") -> str:
    """Format a number; None becomes a dash."""
    return "-" if value is None else format(value, form)


class Progress:
    """A display of the current phase with its elapsed time, and of the latest metrics."""

    def __init__(self, title: str, total: int, done: int):
        """Start the display.

        Args:
          title: what is running and where its output goes.
          total: rows per seed in the whole run.
          done: rows per seed so far.
        """
        self.total, self.done, self.start_done = total, done, done
        self.start = self.since = time.monotonic()
        self.name = "starting"
        self.estimate: float | None = None
        self.share: float | None = None
        self.figures: dict[str, str] = {}
        self.live: Live | None = None
        console = Console()
        if console.is_terminal:
            console.print(title)
            self.live = Live(
                get_renderable=self.render, console=console, refresh_per_second=4, transient=False
            )
            self.live.start()
        else:
            self.say(title)

    def say(self, text: str) -> None:
        """Print one line at once; errors of the output are ignored."""
        with suppress(OSError):
            if self.live is not None:
                self.live.console.print(text)
            else:
                print(text, flush=True)

    def phase(self, name: str, estimate: float | None = None) -> None:
        """Start a phase of the iteration; `estimate` is its expected duration in seconds."""
        self.name, self.estimate, self.share = name, estimate, None
        self.since = time.monotonic()

    def within(self, share: float) -> None:
        """Set the completed share of the phase, where it is known."""
        self.share = share

    def iteration(self, line: dict[str, Any]) -> None:
        """Show the metrics of a finished iteration; `line` holds their means over seeds."""
        self.done = line["step"]
        self.figures = {
            "steps/s": format_number(line["steps_per_second"], ",.0f"),
            "left": format_duration(self.left()),
            "last-100 return": format_number(line["last100_ext_return"]),
            "novelty": format_number(line["int_reward_mean"]),
            "clipped": format_number(line["int_reward_clipped"], ".0%"),
            "entropy": format_number(line["entropy"]),
        }
        if self.live is None:
            figures = "  ".join(f"{name} {value}" for name, value in self.figures.items())
            self.say(f"step {self.done:,} of {self.total:,}  {figures}")

    def left(self) -> float:
        """Return the remaining seconds, at the mean rate so far."""
        gone = time.monotonic() - self.start
        return gone * (self.total - self.done) / max(self.done - self.start_done, 1)

    def render(self) -> Table:
        """Return the current display."""
        gone = time.monotonic() - self.since
        now = f"{self.name} {format_duration(gone)}"
        if self.share is not None:
            now += f" ({self.share:.0%})"
        elif self.estimate is not None:
            now += f" of about {format_duration(self.estimate)}"
        width, filled = 30, round(30 * self.done / self.total)
        table = Table.grid(padding=(0, 2))
        bar = Text("━" * filled, "green") + Text("━" * (width - filled), "bright_black")
        table.add_row(bar, f"{self.done:,} / {self.total:,} steps", now)
        pairs = list(self.figures.items())
        for row in (pairs[:3], pairs[3:]):
            table.add_row(*(Text(f"{name} {value}", "cyan") for name, value in row))
        return table

    def close(self) -> None:
        """Stop the display; the last metrics stay on the screen."""
        with suppress(OSError):
            if self.live is not None:
                self.live.stop()
            sys.stdout.flush()


class ProgressBars:
    """Progress of named tasks: bars on a terminal, otherwise lines `QUIET_SECONDS` apart."""

    def __init__(self) -> None:
        """Create the display without any task."""
        note = progress.TextColumn("{task.fields[note]}")
        self.bars = progress.Progress(*progress.Progress.get_default_columns(), note)
        self.live = self.bars.console.is_terminal
        self.tasks: dict[str, progress.TaskID] = {}
        self.said: dict[str, float] = {}

    def __enter__(self) -> "ProgressBars":
        if self.live:
            self.bars.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self.live:
            self.bars.stop()

    def update(self, name: str, done: int, total: int, note: str = "") -> None:
        """Show the progress of a task; the first call adds the task.

        Args:
          name: the name of the task.
          done: finished items.
          total: all items.
          note: a text shown after the numbers.
        """
        if self.live:
            if name not in self.tasks:
                self.tasks[name] = self.bars.add_task(name, total=total, note=note)
            self.bars.update(self.tasks[name], completed=done, total=total, note=note)
            return
        now = time.monotonic()
        if done >= total or now - self.said.get(name, -QUIET_SECONDS) >= QUIET_SECONDS:
            self.said[name] = now
            with suppress(OSError):
                print(" ".join(f"{name}: {done:,} of {total:,} {note}".split()), flush=True)

    def track(self, name: str, items: Sequence[T]) -> Iterator[T]:
        """Yield the items one after another, and show the progress of the task `name`."""
        for i, item in enumerate(items):
            self.update(name, i, len(items))
            yield item
        self.update(name, len(items), len(items))
