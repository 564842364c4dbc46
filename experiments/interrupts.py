"""SIGINT and SIGTERM, answered where a run can stop without leaving anything half-done."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


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
    destructor or a callback); here it can land in `waiting` alone.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self.may_break = False
        self.previous: dict[int, Any] = {}

    def __enter__(self) -> "Interrupts":
        if threading.current_thread() is threading.main_thread():
            self.previous = {number: signal.signal(number, self.receive) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self.previous.items():
            signal.signal(number, handler)

    def receive(self, number: int, frame: object) -> None:
        """The handler."""
        self.received = number
        if self.may_break:
            self.check()

    def check(self) -> None:
        """A point where the run can stop.

        Raises:
          Interrupted: a signal has come.
        """
        if self.received is not None:
            raise Interrupted(self.received)

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Inside, a signal breaks off the wait at once."""
        self.check()
        self.may_break = True
        try:
            yield
        finally:
            self.may_break = False
