"""Faults of the messages of one direction of a link: byte strings in, byte strings with their due times out. No I/O."""

import random
from collections.abc import Callable
from dataclasses import dataclass, field

MESSAGE_KINDS = ("drop", "delay", "duplicate", "reorder", "corrupt", "split", "garbage")
_Timed = tuple[float, bytes]  # due time [s], message


@dataclass
class MessageFault:
    """One fault while it is active. `share` is the fraction of the messages that it affects."""

    kind: str  # one of MESSAGE_KINDS
    share: float = 1.0
    delay: float = 0.1  # of a delayed message, and of the second part of a split one [s]
    count: int = 4  # changed bytes of a corrupt message, bytes of garbage
    seed: int = 0
    _random: random.Random = field(init=False, repr=False)
    _kept: list[_Timed] = field(init=False, default_factory=list, repr=False)  # overtaken by the next message

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)

    def apply(self, timed: _Timed) -> list[_Timed]:
        """The messages that replace this one."""
        kept = [(max(due, timed[0]), message) for due, message in self.flush()]
        if self._random.random() >= self.share:
            return [timed, *kept]
        return [*_APPLY[self.kind](self, *timed), *kept]

    def flush(self) -> list[_Timed]:
        """The message that was kept back to be overtaken."""
        kept, self._kept = self._kept, []
        return kept

    def _drop(self, due: float, message: bytes) -> list[_Timed]:
        return []

    def _delayed(self, due: float, message: bytes) -> list[_Timed]:
        return [(due + self.delay, message)]

    def _duplicate(self, due: float, message: bytes) -> list[_Timed]:
        return [(due, message), (due, message)]

    def _reorder(self, due: float, message: bytes) -> list[_Timed]:
        self._kept = [(due, message)]
        return []

    def _corrupt(self, due: float, message: bytes) -> list[_Timed]:
        data = bytearray(message)
        for index in self._random.sample(range(len(data)), min(self.count, len(data))):
            data[index] ^= self._random.randint(1, 255)
        return [(due, bytes(data))]

    def _split(self, due: float, message: bytes) -> list[_Timed]:
        if len(message) < 2:
            return [(due, message)]
        cut = self._random.randint(1, len(message) - 1)
        return [(due, message[:cut]), (due + self.delay, message[cut:])]

    def _garbage(self, due: float, message: bytes) -> list[_Timed]:
        return [(due, self._random.randbytes(self.count)), (due, message)]


_APPLY: dict[str, Callable[[MessageFault, float, bytes], list[_Timed]]] = {
    "drop": MessageFault._drop,
    "delay": MessageFault._delayed,
    "duplicate": MessageFault._duplicate,
    "reorder": MessageFault._reorder,
    "corrupt": MessageFault._corrupt,
    "split": MessageFault._split,
    "garbage": MessageFault._garbage,
}


class MessageFaults:
    """The active faults of one direction of a link. The caller holds a lock where several threads use it.

    `ordered` is true for byte streams, in which a delayed message also delays those behind it; datagrams overtake.
    """

    def __init__(self, *, ordered: bool) -> None:
        self._ordered = ordered
        self._active: dict[int, MessageFault] = {}
        self._queue: list[_Timed] = []

    def begin(self, number: int, fault: MessageFault) -> None:
        """Apply `fault` to the messages from now on, until `end(number)`."""
        self._active[number] = fault

    def end(self, number: int) -> None:
        """End a fault; messages that it has delayed stay delayed."""
        fault = self._active.pop(number, None)
        if fault is not None:
            self._add(fault.flush())

    def put(self, message: bytes, now: float) -> None:
        """Take a message that was sent at the time `now` [s]."""
        messages = [(now, message)]
        for fault in self._active.values():
            messages = [changed for timed in messages for changed in fault.apply(timed)]
        self._add(messages)

    def clear(self) -> None:
        """Drop the messages that wait; the faults stay active."""
        for fault in self._active.values():
            fault.flush()
        self._queue = []

    def take(self, now: float) -> list[bytes]:
        """The messages that are due, in the order in which they arrive."""
        ready = [message for due, message in self._queue if due <= now]
        self._queue = [timed for timed in self._queue if timed[0] > now]
        return ready

    @property
    def next_due(self) -> float:
        """Due time of the next message [s]; infinite when none waits."""
        return min((due for due, _ in self._queue), default=float("inf"))

    def _add(self, messages: list[_Timed]) -> None:
        for due, message in messages:
            earliest = max((last for last, _ in self._queue), default=due) if self._ordered else due
            self._queue.append((max(due, earliest), message))
        if not self._ordered:
            self._queue.sort(key=lambda timed: timed[0])
