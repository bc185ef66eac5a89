"""Records of a finished session by time: reads only the chunks of the file that contain them."""

import threading
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from mcap.records import ChunkIndex, Message

from gelflow.errors import PeerError
from gelflow.session.messages import chunk_topics
from gelflow.session.reader import Record, SessionReader

CACHED_CHUNKS = 64  # of about 64 KB
Messages = list[tuple[str, Message]]


class TimeIndex:
    """Finds records of an open session by the time of their recording. Thread-safe.

    A damaged chunk counts as empty; `damaged` is the number of those found so far.

    Raises PeerError for a session without records.
    """

    def __init__(self, session: SessionReader) -> None:
        summary = session.summary
        if summary is None or not summary.chunk_indexes:
            raise PeerError(f"{session.path} contains no records: there is nothing to show")
        self._session, self._summary = session, summary
        self._lock = threading.Lock()
        self._cache: OrderedDict[int, Messages] = OrderedDict()
        self._damaged: set[int] = set()
        self._chunks: list[ChunkIndex] = []
        # Chunks overlap in time by a little: a record may be later than the first ones of the following chunks.
        self._starts: list[float] = []  # [s]
        self._ends: list[float] = []  # of all chunks up to this one [s]
        self._topics: dict[str, list[int]] = {}
        self.extend(summary.chunk_indexes)
        self.start = self._starts[0]  # of the first record, robot time [s]

    @property
    def end(self) -> float:
        """Time of the last record, robot time [s]."""
        return self._ends[-1]

    def extend(self, chunks: Iterable[ChunkIndex]) -> None:
        """Add chunks, which are later than those before: a session that is being recorded grows."""
        ordered = sorted(chunks, key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset))
        for chunk in ordered:
            number = len(self._chunks)
            start, end = (
                self._session.robot_time(chunk.message_start_time),
                self._session.robot_time(chunk.message_end_time),
            )
            # Written one after the other, a chunk may still begin a little before the one in front of it.
            self._starts.append(max(start, self._starts[-1]) if self._starts else start)
            self._ends.append(max(end, self._ends[-1]) if self._ends else end)
            self._chunks.append(chunk)
            for topic in chunk_topics(chunk, self._summary):
                self._topics.setdefault(topic, []).append(number)

    @property
    def damaged(self) -> int:
        """Number of damaged chunks that have been found."""
        return len(self._damaged)

    def topics(self) -> list[str]:
        """Topics of the session that have records."""
        return [topic for topic, chunks in self._topics.items() if chunks]

    def latest(self, topic: str, time: float) -> Record | None:
        """The newest record of a topic at a robot time [s]; None before its first one."""
        chunks = self._topics.get(topic, [])
        newest: Message | None = None
        last = bisect_right(chunks, bisect_right(self._starts, time) - 1)
        for number in reversed(chunks[:last]):
            if newest is not None and self._ends[number] < self._session.robot_time(newest.log_time):
                break
            for _, message in self._of_topic(number, topic):
                if self._session.robot_time(message.log_time) <= time and (
                    newest is None or message.log_time > newest.log_time
                ):
                    newest = message
        return None if newest is None else self._decoded(topic, newest)

    def first(self, topic: str, time: float) -> Record | None:
        """The oldest record of a topic from a robot time [s] on; None after its last one."""
        oldest: Message | None = None
        for number in self._topics.get(topic, []):
            if oldest is not None and self._chunks[number].message_start_time > oldest.log_time:
                break
            if self._session.robot_time(self._chunks[number].message_end_time) >= time:
                for _, message in self._of_topic(number, topic):
                    if self._session.robot_time(message.log_time) >= time and (
                        oldest is None or message.log_time < oldest.log_time
                    ):
                        oldest = message
        return None if oldest is None else self._decoded(topic, oldest)

    def between(self, topic: str, start: float, end: float) -> list[Record]:
        """Records of a topic from `start` to `end` [s], in order of time."""
        found: list[Message] = []
        for number in self._topics.get(topic, []):
            if self._starts[number] > end:
                break
            if self._session.robot_time(self._chunks[number].message_end_time) >= start:
                found += [message for _, message in self._of_topic(number, topic)]
        found.sort(key=lambda message: message.log_time)
        within = [message for message in found if start <= self._session.robot_time(message.log_time) <= end]
        return [record for record in (self._decoded(topic, message) for message in within) if record is not None]

    def spread(self, topics: Sequence[str], start: float, end: float, count: int) -> Iterator[list[Record]]:
        """Records of `topics` in at most `count` chunks between two times [s], one chunk after the other.

        The chunks are spread evenly over the time. Their order is such that those read so far are spread nearly evenly.
        """
        wanted = {number for topic in topics for number in self._topics.get(topic, [])}
        inside = [n for n in sorted(wanted) if self._starts[n] <= end and self._ends[n] >= start]
        if len(inside) > count:
            inside = [inside[k] for k in np.linspace(0, len(inside) - 1, count).round().astype(int)]
        for position in refining_order(len(inside)):
            found = []
            for topic in topics:
                for _, message in self._of_topic(inside[position], topic):
                    record = self._decoded(topic, message)
                    if record is not None and start <= record.time <= end:
                        found.append(record)
            yield found

    def _of_topic(self, number: int, topic: str) -> Messages:
        return [entry for entry in self._messages(number) if entry[0] == topic]

    def _messages(self, number: int) -> Messages:
        with self._lock:
            if number in self._cache:
                self._cache.move_to_end(number)
                return self._cache[number]
            try:
                found = self._session.chunk(self._chunks[number])
            except PeerError:
                self._damaged.add(number)
                found = []
            self._cache[number] = found
            if len(self._cache) > CACHED_CHUNKS:
                self._cache.popitem(last=False)
            return found

    def _decoded(self, topic: str, message: Message) -> Record | None:
        try:
            return self._session.record(topic, message)
        except PeerError:
            return None


def refining_order(count: int) -> Iterator[int]:
    """The numbers below `count` in bit-reversed order: the first k of them are spread nearly evenly, for every k."""
    bits = max(count - 1, 0).bit_length()
    for k in range(1 << bits):
        number = int(f"{k:0{bits}b}"[::-1], 2) if bits else 0
        if number < count:
            yield number
