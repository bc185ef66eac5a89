"""The one source of time. Everything that waits or stamps takes a clock, so that tests need not be slow."""

import os
import time
from dataclasses import dataclass, field
from typing import Protocol

from gelflow.errors import UsageError


class Clock(Protocol):
    """Robot time in seconds. Periods and time-outs are written in robot time; `wall` converts them."""

    def now(self) -> float:
        """Robot time since an arbitrary start [s]; monotonic."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait for `seconds` of robot time [s]."""
        ...

    def wall(self, seconds: float) -> float:
        """The wall-clock length of `seconds` of robot time [s]: what a socket's time-out takes."""
        ...


@dataclass(frozen=True)
class ScaledClock:
    """Robot time runs `factor` times as fast as the wall clock (1 is real time, the only one for a robot).

    Two processes on one machine that are given the same factor agree on the time: both read the system's
    monotonic clock.
    """

    factor: float = field(default=1.0)

    def __post_init__(self) -> None:
        if not 0.01 <= self.factor <= 1000:
            raise UsageError(f"clock factor {self.factor} is outside 0.01 to 1000 (1 is real time)")

    def now(self) -> float:
        return time.monotonic() * self.factor

    def sleep(self, seconds: float) -> None:
        if seconds > 0:
            time.sleep(seconds / self.factor)

    def wall(self, seconds: float) -> float:
        return seconds / self.factor


def raise_priority() -> bool:
    """Give the calling thread real-time priority where the system grants it; says whether it did.

    For threads that must answer within a millisecond or two and sleep most of the time; nothing depends on it.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(20))  # of 1 to 99
    except (AttributeError, OSError):  # no such thing here (macOS), or not allowed
        return False
    return True
