"""Progress of an insertion in the simulated cell, on which the events of fault plans depend."""

import math
from dataclasses import dataclass
from typing import ClassVar, Self

from gelflow.task import InsertionTask

_DESCENDING = 0.1e-3  # below the start height an attempt's descent has begun [m]
_AGAIN = 0.02e-3  # at most this far below the start height the next descent can begin [m]
_APPROACHING = 0.5e-3  # change of height after the grasp at which the approach has begun [m]
PHASES = ("none", "presented", "gripped", "released")


@dataclass
class InsertionProgress:
    """Progress of an insertion. Heights are those of the lower face above the taught hole, as the robot knows it."""

    WORDS: ClassVar[int] = 6  # in shared memory
    time: float = 0.0  # of the simulation [s]
    started: float = math.nan  # time of the first command to gripper or arm [s]
    phase: float = 0.0  # index in PHASES
    height: float = math.nan  # [m]
    gripped_at: float = math.nan  # height at the grasp [m]
    attempts: float = 0.0  # descents that have begun

    @classmethod
    def from_words(cls, words: list[float]) -> Self:
        """Inverse of `to_words`."""
        return cls(*words)

    def to_words(self) -> tuple[float, ...]:
        """The values, for shared memory."""
        return self.time, self.started, self.phase, self.height, self.gripped_at, self.attempts

    @property
    def approaching(self) -> bool:
        """Whether the part was gripped and the arm has moved since."""
        return self.phase == PHASES.index("gripped") and not abs(self.height - self.gripped_at) < _APPROACHING


class InsertionMonitor:
    """Follows the progress from the state of the cell after each step."""

    def __init__(self, task: InsertionTask) -> None:
        self._start_height = task.start_height
        self._above = True  # the arm has been at the start height since the last descent
        self.progress = InsertionProgress()

    def update(self, time: float, phase: str, height: float) -> None:
        """Note the phase of the part and the height of the gripper's lower face above the taught hole [m]."""
        progress = self.progress
        before, progress.phase = progress.phase, float(PHASES.index(phase))
        progress.time, progress.height = time, height
        if phase != "gripped":
            if phase == "presented":
                progress.attempts, progress.gripped_at = 0.0, math.nan
            return
        if before != progress.phase:
            progress.gripped_at, self._above = height, True
        if height > self._start_height - _AGAIN:
            self._above = True
        elif self._above and height < self._start_height - _DESCENDING:
            self._above = False
            progress.attempts += 1

    def note_command(self, time: float) -> None:
        """Note a command to gripper or arm at `time` [s]."""
        if math.isnan(self.progress.started):
            self.progress.started = time
