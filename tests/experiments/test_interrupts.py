import os
import signal
import threading
import time

import pytest

from experiments.interrupts import Interrupted, Interrupts


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_waits_for_a_safe_point(number):
    with Interrupts() as interrupts:
        os.kill(os.getpid(), number)
        time.sleep(0.01)  # nothing is raised here
        with pytest.raises(Interrupted) as stopped:
            interrupts.check()
    assert stopped.value.status == 128 + number


def test_a_wait_is_broken_off_at_once():
    with Interrupts() as interrupts:
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGTERM)).start()
        begun = time.monotonic()
        with pytest.raises(Interrupted), interrupts.waiting():
            threading.Event().wait(10)
        assert time.monotonic() - begun < 5
        with pytest.raises(Interrupted), interrupts.waiting():
            raise AssertionError("a signal that came before is not waited for")


def test_handlers_are_put_back():
    before = signal.getsignal(signal.SIGINT)
    with Interrupts():
        assert signal.getsignal(signal.SIGINT) != before
    assert signal.getsignal(signal.SIGINT) == before
