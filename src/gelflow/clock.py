"""Clocks: code that waits or stamps takes a clock as an argument, so that tests can scale time."""

import contextlib
import math
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Protocol

from gelflow.errors import UsageError
from gelflow.time_sync import MAX_LEAD, MIN_WAIT, TimeSync


class Clock(Protocol):
    """Robot time in seconds. Periods and time-outs are given in robot time; `wall` converts them."""

    def now(self) -> float:
        """Robot time since an arbitrary start [s]; monotonic."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait for `seconds` of robot time [s]."""
        ...

    def wall(self, seconds: float) -> float:
        """Wall-clock duration of `seconds` of robot time [s], for example for a socket's time-out."""
        ...


@dataclass(frozen=True)
class ScaledClock:
    """Robot time that runs `factor` times as fast as the wall clock. A robot requires 1, which is real time.

    Two processes on one machine with the same factor agree on the time: both read the system's monotonic clock.
    `time_sync` names the file of a mock robot (`gelflow.time_sync`). With it robot time also stands still while the
    simulation is late, and `factor` is an upper bound.

    Raises UsageError when `factor` is out of range or the file does not exist.
    """

    factor: float = field(default=1.0)
    time_sync: str = ""
    _sync: TimeSync | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        # Slower than real time, the shortest wall-clock waits of the drivers would last longer than their time-outs.
        if not 1 <= self.factor <= 1000:
            raise UsageError(f"clock factor {self.factor:g} is outside 1 to 1000 (1 is real time)")
        if self.time_sync:
            object.__setattr__(self, "_sync", TimeSync(self.time_sync))

    def now(self) -> float:
        """Robot time since an arbitrary start [s]; monotonic."""
        return time.monotonic() * self.factor if self._sync is None else self._sync.now(self.factor)

    def sleep(self, seconds: float) -> None:
        """Wait for `seconds` of robot time [s]."""
        if self._sync is None:
            if seconds > 0:
                time.sleep(seconds / self.factor)
            return
        self.sleep_until(self.now() + seconds)

    def sleep_until(self, instant: float) -> None:
        """Wait until the robot time `instant` [s].

        A slot that limits robot time waits so, not for a duration: if it is interrupted after the reading of the clock
        that gave the duration, the wait ends after its own limit, which robot time does not reach.
        """
        while (left := instant - self.now()) > 0:
            time.sleep(max(left / self.factor, MIN_WAIT))

    def wall(self, seconds: float) -> float:
        """Wall-clock duration of `seconds` of robot time at full speed [s]."""
        return seconds / self.factor

    @property
    def settings(self) -> tuple[float, str]:
        """Arguments that create the same clock in another process."""
        return self.factor, self.time_sync

    # For the processes of a mock robot

    @property
    def delay(self) -> float:
        """Accumulated delay of robot time against the scaled wall clock since the mock robot started [s]."""
        return 0.0 if self._sync is None else self._sync.delay

    def grant(self, slot: int, until: float) -> None:
        """Let robot time run to `until` [s] for `slot` of `gelflow.time_sync`."""
        if self._sync is not None:
            self._sync.grant(slot, max(until, self.now()))  # robot time never runs backwards

    @contextlib.contextmanager
    def bounded(self, slot: int) -> Iterator[Callable[[], None]]:
        """Robot time advances by at most `MAX_LEAD` in this block, and after each call of the yielded function.

        For computations that a robot's own computer finishes at once and this computer may not.
        """

        def renew() -> None:
            self.grant(slot, self.now() + MAX_LEAD)

        nested = self._sync is not None and math.isfinite(self._sync.limit(slot))
        renew()
        try:
            yield renew
        finally:
            if nested:
                renew()
            else:
                self.grant(slot, math.inf)

    def absorb_delay(self) -> None:
        """Let robot time continue without a jump after it stood still; only the simulated cell's process calls this."""
        if self._sync is not None:
            self._sync.absorb_delay(self.factor)


def raise_priority() -> bool:
    """Give the calling thread real-time priority where the system allows it; return whether it did.

    For threads that must answer within a millisecond or two and sleep most of the time; nothing depends on it. Threads
    and processes that the calling thread starts have normal priority again.
    """
    try:
        # Priorities range from 1 to 99.
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(20))
    except (AttributeError, OSError):  # not available on macOS, or not permitted
        return False
    return True
