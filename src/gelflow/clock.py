"""The one source of time. Everything that waits or stamps takes a clock, so that tests need not be slow."""

import contextlib
import math
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

from gelflow.errors import UsageError
from gelflow.time_sync import LAG, SHORTEST_WAIT, Pace


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
    monotonic clock. With the `pace` file of a mock robot they also agree on when it stands still, because this computer
    can't simulate as fast as that: `factor` is then the most.
    """

    factor: float = field(default=1.0)
    pace: str = ""
    _pace: Pace | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not 0.01 <= self.factor <= 1000:
            raise UsageError(f"clock factor {self.factor} is outside 0.01 to 1000 (1 is real time)")
        if self.pace:
            object.__setattr__(self, "_pace", Pace(self.pace))

    def now(self) -> float:
        return time.monotonic() * self.factor if self._pace is None else self._pace.now(self.factor)

    def sleep(self, seconds: float) -> None:
        if self._pace is None:
            if seconds > 0:
                time.sleep(seconds / self.factor)
            return
        end = self.now() + seconds
        while (left := end - self.now()) > 0:
            time.sleep(max(left / self.factor, SHORTEST_WAIT))

    def wall(self, seconds: float) -> float:
        return seconds / self.factor

    @property
    def settings(self) -> tuple[float, str]:
        """What another process makes the same clock of."""
        return self.factor, self.pace

    # For who plays the robot

    @property
    def lost(self) -> float:
        """How far robot time is behind `factor` times the wall clock's since the mock robot was made [s]."""
        return 0.0 if self._pace is None else self._pace.lost

    def allow(self, slot: int, until: float) -> None:
        """Robot time may run to `until` [s], as far as who has `slot` is concerned: see `gelflow.time_sync`."""
        if self._pace is not None:
            self._pace.allow(slot, max(until, self.now()))  # it never runs back

    @contextlib.contextmanager
    def urgent(self, slot: int) -> Iterator[None]:
        """What a robot's own computer does at once: robot time waits where this one is slower."""
        self.allow(slot, self.now() + LAG)
        try:
            yield
        finally:
            self.allow(slot, math.inf)

    def settle(self) -> None:
        """By the world's process alone, in every step: what was held back is lost, and not made up for."""
        if self._pace is not None:
            self._pace.settle(self.factor)


def raise_priority() -> bool:
    """Give the calling thread real-time priority where the system grants it; says whether it did.

    For threads that must answer within a millisecond or two and sleep most of the time; nothing depends on it.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(20))  # of 1 to 99
    except (AttributeError, OSError):  # no such thing here (macOS), or not allowed
        return False
    return True
