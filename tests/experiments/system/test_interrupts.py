import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from experiments.system.interrupts import Interrupted, Interrupts


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_Interrupts_signal_waits_for_a_safe_point(number):
    with Interrupts() as interrupts:
        interrupts.begin()
        os.kill(os.getpid(), number)
        time.sleep(0.01)  # no exception is raised here
        with pytest.raises(Interrupted) as stopped:
            interrupts.check()
    assert stopped.value.status == 128 + number


def test_Interrupts_signal_in_a_wait_ends_it_at_once():
    with Interrupts() as interrupts:
        interrupts.begin()
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGTERM)).start()
        begun = time.monotonic()
        with pytest.raises(Interrupted), interrupts.waiting():
            threading.Event().wait(10)
        assert time.monotonic() - begun < 5
        with pytest.raises(Interrupted), interrupts.waiting():
            raise AssertionError("a signal that came before is not waited for")


def test_Interrupts_signal_in_a_wait_with_grace_ends_it_after_the_grace():
    with Interrupts() as interrupts:
        interrupts.begin()
        with interrupts.waiting(5):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.2)  # the wait ends within the grace: its result is kept
        with pytest.raises(Interrupted):
            interrupts.check()
    with Interrupts() as interrupts:
        interrupts.begin()
        begun = time.monotonic()
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGTERM)).start()
        with pytest.raises(Interrupted), interrupts.waiting(0.3):
            threading.Event().wait(10)
        assert 0.25 < time.monotonic() - begun < 5


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_Interrupts_signal_before_the_start_ends_the_process(number):
    """Send the signal in `__del__`, where Python ignores exceptions."""
    code = (
        "import os, signal, time\nfrom experiments.system.interrupts import Interrupts\n"
        "class Loud:\n    def __del__(self):\n"
        f"        os.kill(os.getpid(), {int(number)}); time.sleep(1)\n"
        "with Interrupts():\n    Loud(); print('went on')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 128 + number
    assert done.stdout == ""
    assert done.stderr == "sndjax: interrupted before the first step\n"


def test_Interrupts_exception_swallowed_in_a_wait_is_raised_again(capfd):
    class Slow:
        def __del__(self):
            time.sleep(0.5)  # Python ignores an exception that is raised here

    def del_slowly_and_wait():
        Slow()
        threading.Event().wait(20)

    with Interrupts() as interrupts:
        interrupts.begin()
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGTERM)).start()
        begun = time.monotonic()
        with pytest.raises(Interrupted), interrupts.waiting():
            del_slowly_and_wait()
        assert time.monotonic() - begun < 10
    assert capfd.readouterr().err == ""


def test_Interrupts_second_signal_ends_a_wait_at_once():
    with Interrupts() as interrupts:
        interrupts.begin()
        for delay in (0.1, 0.3):
            threading.Timer(delay, os.kill, (os.getpid(), signal.SIGTERM)).start()
        begun = time.monotonic()
        with pytest.raises(Interrupted), interrupts.waiting(20):
            threading.Event().wait(20)
        assert time.monotonic() - begun < 10


def test_Interrupts_exit_restores_the_handlers():
    before = signal.getsignal(signal.SIGINT)
    with Interrupts():
        assert signal.getsignal(signal.SIGINT) != before
    assert signal.getsignal(signal.SIGINT) == before
