"""What lets a scaled clock run no faster than a simulated robot can follow: some numbers in a shared file.

A mock robot is several processes. Who must keep up writes, again and again, how far robot time may run before the next
step is done; robot time stops there until it is. One of them, the pacer, writes down how much was lost so.
"""

import math
import mmap
import time
from array import array

from gelflow.errors import UsageError

_SLOTS = 5  # who must keep up; the last one is the robot's user, while a frame may mean that it must stop
WORLD, CONTROLLER, LEFT_CAMERA, RIGHT_CAMERA, RUNNER = range(_SLOTS)
LAG = 0.02  # how far robot time may run past what is due, before it waits [s]
SHORTEST_WAIT = 2e-4  # of those who wait while robot time stands still [s, wall]
_WORDS = 1 + 2 * _SLOTS  # time lost [s], then for each slot: wall time of its last word [s], its limit [s, robot time]
_PATIENCE = 5.0  # who says nothing for longer is gone, and holds nobody back [s, wall]


class Pace:
    """The numbers, mapped from the file at `path`. Raises UsageError when there is no such file."""

    def __init__(self, path: str) -> None:
        try:
            with open(path, "r+b") as file:
                self._words = memoryview(mmap.mmap(file.fileno(), 8 * _WORDS)).cast("d")
        except (OSError, ValueError):
            raise UsageError(f"there is no mock robot behind {path}: has it ended? start it again") from None

    @staticmethod
    def create(path: str) -> None:
        """A new file, in which nobody holds anybody back."""
        words = array("d", [0.0] * _WORDS)
        for slot in range(_SLOTS):
            words[2 + 2 * slot] = math.inf
        with open(path, "xb") as file:
            words.tofile(file)

    @property
    def lost(self) -> float:
        """How far robot time is behind what it would be if nobody had held it back [s]."""
        return self._words[0]

    def allow(self, slot: int, until: float) -> None:
        """The process of `slot` is alive, and robot time may run to `until` [s]."""
        self._words[1 + 2 * slot] = time.monotonic()
        self._words[2 + 2 * slot] = until

    def now(self, factor: float) -> float:
        """Robot time [s] that runs at most `factor` times as fast as the wall clock."""
        return self._read(factor)[0]

    def settle(self, factor: float) -> None:
        """By the pacer alone: what is held back now is lost for good, so that robot time does not jump after it."""
        now, wall = self._read(factor)
        self._words[0] = wall * factor - now

    def _read(self, factor: float) -> tuple[float, float]:
        """Robot time, and the wall time at which it was read [s]."""
        words = self._words
        # In this order: who is interrupted in between ends at a limit that had been reached, and time never runs back.
        limits = [(words[2 + 2 * slot], words[1 + 2 * slot]) for slot in range(_SLOTS)]
        lost = words[0]
        wall = time.monotonic()
        now = wall * factor - lost
        for limit, heard in limits:
            if now > limit:
                now = min(now, limit + max(0.0, wall - heard - _PATIENCE) * factor)
        return now, wall
