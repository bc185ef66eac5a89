"""Signals that end a run: raised once, deferred while devices are opened, and passed on at once."""

import os
import signal
import threading
import time

import pytest

from gelflow import interrupts
from gelflow.interrupts import Interrupted, interruptible


@pytest.mark.parametrize("number", interrupts.SIGNALS)
def test_signal_is_raised_once_and_passed_on_at_once(number: int) -> None:
    held = threading.Event()
    ignored = False
    before = signal.getsignal(number)
    with pytest.raises(Interrupted) as caught, interruptible() as at_once:
        at_once.append(held.set)
        try:
            os.kill(os.getpid(), number)
            time.sleep(20)
        except Interrupted:
            os.kill(os.getpid(), signal.SIGTERM)  # during the shutdown
            time.sleep(0.05)
            ignored = True
            raise
    assert ignored and held.wait(20)
    assert caught.value.number == number and str(caught.value) == signal.Signals(number).name
    assert isinstance(caught.value, KeyboardInterrupt)
    assert signal.getsignal(number) == before


def test_deferred_signal_is_raised_at_the_end_of_the_block() -> None:
    held = threading.Event()
    with pytest.raises(Interrupted, match="SIGTERM"), interruptible() as at_once:
        at_once.append(held.set)
        interrupts.defer()
        os.kill(os.getpid(), signal.SIGTERM)
        assert held.wait(20), "the arm is held although the exception is deferred"
        time.sleep(0.05)
        interrupts.resume()
        pytest.fail("not raised")


def test_deferral_without_a_signal_has_no_effect() -> None:
    with interruptible():
        interrupts.defer()
        interrupts.resume()
    interrupts.defer()
    interrupts.resume()
