"""Time synchronization of the mock robot's processes, by a small shared file.

Robot time of a mock robot must not run faster than its simulation. Each process that has to keep up (a slot) grants
robot time a limit, until its next step is done; robot time stops at the earliest limit. One of them, the simulated
cell, accumulates the delay, so that robot time continues from where it stopped. Two slots belong to the other side,
since a mock robot and the runner share one computer: the arm's driver, and the runner, which may have to stop the arm
after a camera frame.
"""

import math
import mmap
import struct
import time
from array import array

from gelflow.errors import UsageError

_SLOTS = 7
SIMULATED_CELL, CONTROLLER, LEFT_CAMERA, RIGHT_CAMERA, GRIPPER, ARM_DRIVER, RUNNER = range(_SLOTS)
MAX_LEAD = 0.02  # lead of robot time over the last finished step, at most [s]
MIN_WAIT = 2e-4  # shortest sleep while robot time stands still [s, wall]
# Delay [s], then for each slot: wall time of its last grant [s] and its limit [s, robot time]; then the mark.
_WORDS = 2 + 2 * _SLOTS
_MARK = struct.unpack("d", b"gelsync1")[0]  # by which such a file is recognized
_SLOT_TIMEOUT = 15.0  # a slot that grants nothing for longer is taken for dead and ignored [s, wall]


class TimeSync:
    """The shared numbers, mapped from the file at `path`.

    Raises UsageError when there is no such file, or it is none of a mock robot.
    """

    def __init__(self, path: str) -> None:
        try:
            with open(path, "r+b") as file:
                self._words = memoryview(mmap.mmap(file.fileno(), 8 * _WORDS)).cast("d")
            if self._words[-1] != _MARK:
                raise ValueError("not a time-sync file")
        except (OSError, ValueError):
            raise UsageError(f"there is no mock robot behind {path}: has it ended? start it again") from None
        self._newest = -math.inf  # robot time read here so far [s]

    @staticmethod
    def create(path: str) -> None:
        """Create the file, with no limit in any slot."""
        words = array("d", [0.0] * _WORDS)
        for slot in range(_SLOTS):
            words[2 + 2 * slot] = math.inf
        words[-1] = _MARK
        with open(path, "xb") as file:
            words.tofile(file)

    @property
    def delay(self) -> float:
        """Accumulated delay of robot time against the scaled wall clock [s]."""
        return self._words[0]

    def grant(self, slot: int, until: float) -> None:
        """Let robot time run to `until` [s] for `slot`; also marks the slot as alive."""
        self._words[1 + 2 * slot] = time.monotonic()
        self._words[2 + 2 * slot] = until

    def limit(self, slot: int) -> float:
        """Robot time [s] up to which `slot` lets it run."""
        return self._words[2 + 2 * slot]

    def now(self, factor: float) -> float:
        """Robot time [s], which runs at most `factor` times as fast as the wall clock."""
        return self._read(factor)[0]

    def absorb_delay(self, factor: float) -> None:
        """Add the present hold-up to the delay, so that robot time does not jump after it.

        Only one process may call this: the simulated cell.
        """
        now, wall = self._read(factor)
        self._words[0] = wall * factor - now

    def _read(self, factor: float) -> tuple[float, float]:
        """Robot time, and the wall time at which it was read [s]."""
        words = self._words.tolist()
        wall = time.monotonic()
        # A process that is interrupted between the two would combine numbers of different times: robot time would run
        # ahead, and backwards at the next reading.
        while (again := self._words.tolist()) != words:
            words, wall = again, time.monotonic()
        now = wall * factor - words[0]
        for granted, limit in zip(words[1:-1:2], words[2:-1:2], strict=True):
            if now > limit:
                now = min(now, limit + max(0.0, wall - granted - _SLOT_TIMEOUT) * factor)
        # A process that is interrupted after it has read robot time grants a limit that is already past.
        self._newest = now = max(now, self._newest)
        return now, wall
