"""Ring buffer of all EGM cycles in memory shared by the EGM process (writer) and its parent (reader).

One writer, one reader, records of fixed size: a record is written before it is counted, so the reader never sees a
partial record. Unread records are never overwritten: a full buffer rejects the record, and the writer stops the arm.
"""

import mmap
import struct
from typing import NamedTuple

from gelflow.errors import UsageError
from gelflow.geometry import PoseTuple
from gelflow.helper_process import memory_file
from gelflow.real.egm.reference_generator import EgmFlag
from gelflow.real.egm.timing import WORDS, EgmTiming, TimingCounters
from gelflow.real.kinematics import Joints

_RECORD = struct.Struct("@32d")
_WRITTEN, _READ, _FOREIGN, _MALFORMED, _DUPLICATES, _TIMING = range(6)
_HEADER = 8 * (_TIMING + WORDS)  # bytes: counts of written and read records, of ignored messages, and of times
_NAN7 = (float("nan"),) * 7


class EgmCycle(NamedTuple):
    """One 4 ms cycle."""

    stamp: float  # robot time of reception [s]
    commanded: PoseTuple | None  # the target: position [m] and quaternion w x y z; None: no target, hold
    applied: PoseTuple | None  # the reference that was sent; None: nothing was sent
    measured: PoseTuple  # the pose reported by the controller
    joints: Joints  # [rad]
    flags: EgmFlag
    sequence: int  # message counter of the controller
    controller_time: float  # clock of the controller [s]
    answered: float  # robot time at which the answer was sent [s]; NaN without an answer


class MessageCounts(NamedTuple):
    """Counts of ignored messages."""

    foreign: int  # from a sender other than the controller
    malformed: int  # not EGM messages
    duplicates: int  # repeated or late messages


class EgmCycleLog:
    """A bounded log in an anonymous file that both processes map into memory."""

    def __init__(self, descriptor: int, capacity: int) -> None:
        self._map = mmap.mmap(descriptor, _HEADER + capacity * _RECORD.size)
        # Native 8-byte words are stored atomically, so the other process never reads a partial count.
        self._words = memoryview(self._map)[:_HEADER].cast("q")
        self._timing = TimingCounters(self._words[_TIMING:])
        self._capacity = capacity

    @staticmethod
    def create(capacity: int) -> int:
        """File descriptor of a log for `capacity` records; the file has no name and is deleted with its last user."""
        if capacity < 2:
            raise UsageError(f"a log needs a capacity of at least 2 records, got {capacity}")
        return memory_file(_HEADER + capacity * _RECORD.size)

    def close(self) -> None:
        """Unmap the memory."""
        del self._timing
        self._words.release()
        self._map.close()

    @property
    def full(self) -> bool:
        """Whether `append` would reject a record."""
        return self._words[_WRITTEN] - self._words[_READ] >= self._capacity

    @property
    def counts(self) -> MessageCounts:
        """Ignored messages so far."""
        return MessageCounts(self._words[_FOREIGN], self._words[_MALFORMED], self._words[_DUPLICATES])

    @property
    def timing(self) -> EgmTiming:
        """Statistics of all cycles so far."""
        return self._timing.read(self._words[_WRITTEN])

    def count(self, *, foreign: int = 0, malformed: int = 0, duplicates: int = 0) -> None:
        """Add to the counts of ignored messages. Writer only."""
        self._words[_FOREIGN] += foreign
        self._words[_MALFORMED] += malformed
        self._words[_DUPLICATES] += duplicates

    def append(self, record: EgmCycle) -> bool:
        """Add a record. False: the log is full and nothing was written. Writer only."""
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
        self._timing.add(record.sequence, record.stamp, record.controller_time, record.answered)
        if EgmFlag.UNANSWERED in record.flags:
            self._timing.count_unanswered()
        return True

    def latest(self) -> EgmCycle | None:
        """The newest record, read or not; None before the first."""
        while written := self._words[_WRITTEN]:
            record = self._record(written - 1)
            # The record is valid unless the writer has gone once around the buffer in the meantime.
            if self._words[_WRITTEN] - written < self._capacity - 1:
                return record
        return None

    def drain(self) -> list[EgmCycle]:
        """All unread records. Reader only."""
        read, written = self._words[_READ], self._words[_WRITTEN]
        records = [self._record(number) for number in range(read, written)]
        self._words[_READ] = written
        return records

    def _record(self, number: int) -> EgmCycle:
        v = _RECORD.unpack_from(self._map, _HEADER + number % self._capacity * _RECORD.size)
        return EgmCycle(
            stamp=v[0],
            commanded=_pose(v[1:8]),
            applied=_pose(v[8:15]),
            measured=((v[15], v[16], v[17]), (v[18], v[19], v[20], v[21])),
            joints=(v[22], v[23], v[24], v[25], v[26], v[27]),
            flags=EgmFlag(int(v[28])),
            sequence=int(v[29]),
            controller_time=v[30],
            answered=v[31],
        )


def _pose(v: tuple[float, ...]) -> PoseTuple | None:
    # NaN encodes a missing pose.
    return None if v[0] != v[0] else ((v[0], v[1], v[2]), (v[3], v[4], v[5], v[6]))
