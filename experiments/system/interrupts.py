"""Handling of SIGINT and SIGTERM at points where a run can stop with all its work complete."""

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)
AGAIN = 0.2  # seconds until an exception that Python discarded is raised again


class Interrupted(Exception):
    """The exception raised for a signal that asks the run to stop.

    Attributes:
      status: the exit status, 128 + the signal's number, as shells and schedulers expect.
    """

    def __init__(self, number: int):
        super().__init__(signal.Signals(number).name)
        self.status = 128 + number


active: "Interrupts | None" = None  # the one whose handlers this process has


def restore_signals_in_child() -> None:
    """Give a forked process, such as a worker of an environment, the default handlers.

    A signal to the whole group, as Ctrl-C in a terminal, ends it at once; the run takes the error
    that follows for the signal it is, see `wait_for_signal`.
    """
    if active is not None:
        for number in active.previous:
            signal.signal(number, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, 0)


os.register_at_fork(after_in_child=restore_signals_in_child)


class Interrupts:
    """A context manager that stores a signal until `check`, or interrupts the current wait.

    An exception raised by a signal handler can appear at any line, also where Python discards
    it (in a destructor or a callback). Here it can appear only inside `waiting`, and it is raised
    repeatedly until it reaches the caller. Before `begin` there is no work to save, and a signal
    ends the process.
    """

    def __init__(self) -> None:
        self.begun = False
        self.received: int | None = None
        self.grace: float | None = None  # seconds; None: not inside `waiting`
        self.previous: dict[int, Any] = {}

    def __enter__(self) -> "Interrupts":
        global active
        active = self
        if threading.current_thread() is threading.main_thread():
            self.previous = {number: signal.signal(number, self.receive) for number in SIGNALS}
            self.previous[signal.SIGALRM] = signal.signal(signal.SIGALRM, self.give_up)
        self.unraisable, sys.unraisablehook = sys.unraisablehook, self.swallowed
        return self

    def __exit__(self, *_: object) -> None:
        global active
        active = None
        for number, handler in self.previous.items():
            signal.signal(number, handler)
        sys.unraisablehook = self.unraisable

    def swallowed(self, about: Any) -> None:
        """Ignore an Interrupted in a destructor or a callback, because it is raised again.

        Other exceptions go to the previous hook.
        """
        if about.exc_type is not Interrupted:
            self.unraisable(about)

    def begin(self) -> None:
        """Mark that there is work to save, and that `check` is called often from here on."""
        self.begun = True

    def receive(self, number: int, frame: object) -> None:
        """Handle SIGINT and SIGTERM; a second signal interrupts a wait at once."""
        if not self.begun:
            show_cursor = "\x1b[?25h" if sys.stderr.isatty() else ""
            print(f"{show_cursor}sndjax: interrupted before the first step", file=sys.stderr)
            os._exit(128 + number)
        again, self.received = self.received is not None, number
        if self.grace is not None:
            self.alarm(0 if again else self.grace)

    def wait_for_signal(self, patience: float = 0.5) -> bool:
        """Return True if a signal was received, or is received within `patience` seconds.

        For errors that a signal may have caused, by ending a worker process too.
        """
        deadline = time.monotonic() + patience
        while self.received is None and time.monotonic() < deadline:
            time.sleep(0.01)
        return self.received is not None

    def alarm(self, delay: float) -> None:
        """Start the timer that ends the wait after `delay` seconds."""
        signal.setitimer(signal.ITIMER_REAL, max(delay, 1e-6), AGAIN)

    def give_up(self, number: int, frame: object) -> None:
        """Handle SIGALRM: the time limit of the wait is reached."""
        if self.grace is not None:
            self.check()

    def check(self) -> None:
        """Raise Interrupted if a signal was received; call this where the run can stop.

        Raises:
          Interrupted: a signal was received.
        """
        if self.received is not None:
            raise Interrupted(self.received)

    @contextmanager
    def waiting(self, grace: float = 0.0, started: bool = False) -> Iterator[None]:
        """Let a signal interrupt the enclosed wait, `grace` seconds after the signal arrives.

        A second signal interrupts the wait at once.

        Args:
          grace: in seconds.
          started: what is waited for was started before; it gets its grace even if a signal has
            arrived since then.

        Raises:
          Interrupted: a signal was received.
        """
        if not started:
            self.check()
        self.grace = grace
        try:
            if self.received is not None:  # the signal has arrived by now
                self.alarm(grace)
            yield
        finally:
            self.grace = None
            signal.setitimer(signal.ITIMER_REAL, 0)
