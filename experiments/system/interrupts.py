"""SIGINT and SIGTERM, answered where a run can stop without leaving anything half-done."""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)
AGAIN = 0.2  # seconds until an exception that was swallowed is raised again


class Interrupted(Exception):
    """A signal asked the run to stop.

    Attributes:
      status: the exit status that shells and schedulers know, 128 + the signal's number.
    """

    def __init__(self, number: int):
        super().__init__(signal.Signals(number).name)
        self.status = 128 + number


class Interrupts:
    """While it is entered, a signal is kept until `check`, or breaks off what is waited for.

    An exception out of a signal handler can land anywhere, also where it is swallowed (in a
    destructor or a callback); here it can land in `waiting` alone, and is raised until it is
    met. Before `begin` there is nothing to keep, and a signal ends the process.
    """

    def __init__(self) -> None:
        self.begun = False
        self.received: int | None = None
        self.grace: float | None = None  # None: nothing is being waited for
        self.previous: dict[int, Any] = {}

    def __enter__(self) -> "Interrupts":
        if threading.current_thread() is threading.main_thread():
            self.previous = {number: signal.signal(number, self.receive) for number in SIGNALS}
            self.previous[signal.SIGALRM] = signal.signal(signal.SIGALRM, self.give_up)
        self.unraisable, sys.unraisablehook = sys.unraisablehook, self.swallowed
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self.previous.items():
            signal.signal(number, handler)
        sys.unraisablehook = self.unraisable

    def swallowed(self, about: Any) -> None:
        """An exception in a destructor or a callback goes nowhere; ours comes again."""
        if about.exc_type is not Interrupted:
            self.unraisable(about)

    def begin(self) -> None:
        """From here on there is something to lose, and `check` is called often."""
        self.begun = True

    def receive(self, number: int, frame: object) -> None:
        """The handler of both."""
        if not self.begun:
            show_cursor = "\x1b[?25h" if sys.stderr.isatty() else ""
            print(f"{show_cursor}sndjax: interrupted before the first step", file=sys.stderr)
            os._exit(128 + number)
        again, self.received = self.received is not None, number
        if self.grace is not None:
            self.alarm(0 if again else self.grace)

    def alarm(self, delay: float) -> None:
        """Give the wait so many seconds."""
        signal.setitimer(signal.ITIMER_REAL, max(delay, 1e-6), AGAIN)

    def give_up(self, number: int, frame: object) -> None:
        """The handler of the alarm: the wait has had its time."""
        if self.grace is not None:
            self.check()

    def check(self) -> None:
        """A point where the run can stop.

        Raises:
          Interrupted: a signal has come.
        """
        if self.received is not None:
            raise Interrupted(self.received)

    @contextmanager
    def waiting(self, grace: float = 0.0) -> Iterator[None]:
        """Inside, a signal breaks off the wait unless it is over within `grace` seconds.

        A second signal breaks it off at once.
        """
        self.check()
        self.grace = grace
        try:
            if self.received is not None:  # it came since the check
                self.alarm(grace)
            yield
        finally:
            self.grace = None
            signal.setitimer(signal.ITIMER_REAL, 0)
