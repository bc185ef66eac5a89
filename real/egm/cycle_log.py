"""The log of all cycles, in memory shared by the EGM process (which writes) and its parent (which reads).

One writer, one reader, fixed records: a record is written first and counted afterwards, so the reader never sees half
of one. Nothing is ever overwritten before it was read: a full ring refuses, and the writer stops the arm.
"""

import mmap
import os
import struct
import tempfile
from typing import NamedTuple

from gelflow.errors import UsageError
from gelflow.geometry import PoseTuple
from gelflow.real.egm.reference_generator import EgmFlag
from gelflow.real.kinematics import Joints

_RECORD = struct.Struct("@32d")
_HEADER = 64  # bytes: how many were written, how many were read, messages that were not for us
_WRITTEN, _READ, _FOREIGN, _MALFORMED, _DUPLICATES = range(5)
_NAN7 = (float("nan"),) * 7


class EgmCycle(NamedTuple):
    """One 4 ms cycle."""

    stamp: float  # robot time of reception [s]
    commanded: PoseTuple | None  # the target: position [m] and quaternion w x y z; None: no target, hold
    applied: PoseTuple | None  # the reference that was sent; None: nothing was sent
    measured: PoseTuple  # the controller's pose
    joints: Joints  # [rad]
    flags: EgmFlag
    sequence: int  # the controller's count of its messages
    controller_time: float  # the controller's clock [s]
    answered: float  # robot time at which the answer was sent [s]; NaN when none was


class MessageCounts(NamedTuple):
    """Messages that were not followed."""

    foreign: int  # from another sender than the controller
    malformed: int  # no EGM messages
    duplicates: int  # seen before, or too late


class EgmCycleLog:
    """A bounded log in an anonymous file that both processes map."""

    def __init__(self, descriptor: int, capacity: int) -> None:
        self._map = mmap.mmap(descriptor, _HEADER + capacity * _RECORD.size)
        # Native 8-byte words: one store each, so that the other process never reads half a count.
        self._words = memoryview(self._map)[:_HEADER].cast("q")
        self._capacity = capacity

    @staticmethod
    def create(capacity: int) -> int:
        """A file descriptor for a ring of `capacity` records; the file has no name and goes with its last user."""
        if capacity < 2:
            raise UsageError(f"a log needs room for at least 2 records, got {capacity}")
        if hasattr(os, "memfd_create"):
            descriptor = os.memfd_create("gelflow-egm")
        else:
            with tempfile.TemporaryFile() as file:
                descriptor = os.dup(file.fileno())
        os.ftruncate(descriptor, _HEADER + capacity * _RECORD.size)
        return descriptor

    def close(self) -> None:
        self._words.release()
        self._map.close()

    @property
    def full(self) -> bool:
        return self._words[_WRITTEN] - self._words[_READ] >= self._capacity

    @property
    def counts(self) -> MessageCounts:
        return MessageCounts(self._words[_FOREIGN], self._words[_MALFORMED], self._words[_DUPLICATES])

    def count(self, *, foreign: int = 0, malformed: int = 0, duplicates: int = 0) -> None:
        """Writer only."""
        self._words[_FOREIGN] += foreign
        self._words[_MALFORMED] += malformed
        self._words[_DUPLICATES] += duplicates

    def append(self, record: EgmCycle) -> bool:
        """Add a record. False: the ring is full, nothing was written. Writer only."""
        if self.full:
            return False
        written = self._words[_WRITTEN]
        commanded = (*record.commanded[0], *record.commanded[1]) if record.commanded else _NAN7
        applied = (*record.applied[0], *record.applied[1]) if record.applied else _NAN7
        _RECORD.pack_into(
            self._map,
            _HEADER + written % self._capacity * _RECORD.size,
            *(record.stamp, *commanded, *applied, *record.measured[0], *record.measured[1], *record.joints),
            *(record.flags, record.sequence, record.controller_time, record.answered),
        )
        self._words[_WRITTEN] = written + 1
        return True

    def latest(self) -> EgmCycle | None:
        """The newest record, read or not; None before the first."""
        while written := self._words[_WRITTEN]:
            record = self._record(written - 1)
            # Its place is safe unless the writer went all the way round meanwhile.
            if self._words[_WRITTEN] - written < self._capacity - 1:
                return record
        return None

    def drain(self) -> list[EgmCycle]:
        """All records that were not read yet. Reader only."""
        read, written = self._words[_READ], self._words[_WRITTEN]
        records = [self._record(number) for number in range(read, written)]
        self._words[_READ] = written
        return records

    def _record(self, number: int) -> EgmCycle:
        v = _RECORD.unpack_from(self._map, _HEADER + number % self._capacity * _RECORD.size)
        return EgmCycle(
            stamp=v[0],
            commanded=_frame(v[1:8]),
            applied=_frame(v[8:15]),
            measured=((v[15], v[16], v[17]), (v[18], v[19], v[20], v[21])),
            joints=(v[22], v[23], v[24], v[25], v[26], v[27]),
            flags=EgmFlag(int(v[28])),
            sequence=int(v[29]),
            controller_time=v[30],
            answered=v[31],
        )


def _frame(v: tuple[float, ...]) -> PoseTuple | None:
    # A position that is not a number stands for none.
    return None if v[0] != v[0] else ((v[0], v[1], v[2]), (v[3], v[4], v[5], v[6]))
