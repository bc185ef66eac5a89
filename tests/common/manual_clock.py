"""A clock that a test sets."""

from dataclasses import dataclass


@dataclass
class ManualClock:
    """Robot time that stands still until the test sets it, or code sleeps."""

    time: float = 0.0

    def now(self) -> float:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.time += seconds

    def wall(self, seconds: float) -> float:
        return seconds
