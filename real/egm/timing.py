"""Statistics of the EGM cycles: missed cycles, jitter of the messages, and times of the answers."""

from typing import NamedTuple

BINS = 256
BIN = 1e-4  # width of a bin [s]; the last bin contains all longer times
WORDS = 2 + 2 * BINS  # lost and unanswered messages, then the bins of jitter and answers
_LOST, _UNANSWERED, _JITTER, _ANSWER = 0, 1, 2, 2 + BINS


class EgmTiming(NamedTuple):
    """Timing of all cycles since the connection. Times [s, robot time], as the upper end of their bin of 0.1 ms."""

    cycles: int  # messages received
    lost: int  # messages that the robot counted and that did not arrive
    unanswered: int  # messages that arrived together with a newer one, which was answered
    jitter: tuple[float, float, float, float]  # 50 %, 99 %, 99.9 %, largest: |interval − interval of the robot's clock|
    answer: tuple[float, float, float, float]  # the same of the time from a message to its answer

    @property
    def missed(self) -> float:
        """Fraction of the robot's cycles without an answer to their message."""
        return (self.lost + self.unanswered) / max(1, self.cycles + self.lost)


class TimingCounters:
    """Counters in memory that both processes share; only the EGM process adds to them."""

    def __init__(self, words: memoryview) -> None:
        self._words = words
        self._before: tuple[int, float, float] | None = None

    def add(self, sequence: int, stamp: float, controller_time: float, answered: float) -> None:
        """Add a cycle: message count, robot time of reception, clock of the robot, and robot time of its answer [s].

        NaN as the time of the answer: a newer message was answered instead, or nothing is sent.
        """
        words = self._words
        if self._before is not None and sequence > self._before[0]:
            words[_LOST] += sequence - self._before[0] - 1
            jitter = abs((stamp - self._before[1]) - (controller_time - self._before[2]))
            words[_JITTER + _bin(jitter)] += 1
        self._before = sequence, stamp, controller_time
        if answered == answered:
            words[_ANSWER + _bin(answered - stamp)] += 1

    def count_unanswered(self) -> None:
        """Count a message that arrived together with a newer one."""
        self._words[_UNANSWERED] += 1

    def read(self, cycles: int) -> EgmTiming:
        """The statistics of `cycles` messages."""
        words = self._words.tolist()
        jitter, answer = words[_JITTER:_ANSWER], words[_ANSWER : _ANSWER + BINS]
        return EgmTiming(cycles, words[_LOST], words[_UNANSWERED], _quantiles(jitter), _quantiles(answer))


def _bin(seconds: float) -> int:
    return int(min(max(seconds / BIN, 0.0), BINS - 1.0))


def _quantiles(counts: list[int]) -> tuple[float, float, float, float]:
    total = sum(counts)
    fifty, ninety_nine, most, largest = (_quantile(counts, share * total) for share in (0.5, 0.99, 0.999, 1.0))
    return fifty, ninety_nine, most, largest


def _quantile(counts: list[int], needed: float) -> float:
    if needed == 0:
        return float("nan")
    found = 0
    for number, count in enumerate(counts):
        found += count
        if found >= needed:
            return BIN * (number + 1)
    return BIN * len(counts)
