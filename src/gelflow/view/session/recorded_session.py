"""A recorded session as moments: what was known at any time of it."""

from bisect import bisect_right
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from gelflow.errors import GelflowError, PeerError
from gelflow.geometry import Pose
from gelflow.session.messages import Damage
from gelflow.session.reader import Record, SessionReader
from gelflow.session.records import SENSORS
from gelflow.session.time_index import TimeIndex
from gelflow.view.robot.cell_geometry import CellGeometry
from gelflow.view.session.marker_reader import MarkerReader
from gelflow.view.session.marks import Mark, marks, phases
from gelflow.view.session.moment import Moment

_STORY = ("/event", "/attempt", "/decision")


class RecordedSession:
    """An open session file and its events. Use it as a context manager.

    Raises UsageError for a file that is no session, PeerError for one that is unfinished, damaged or empty.
    """

    def __init__(self, path: str | Path) -> None:
        self.reader = SessionReader(path).open()
        try:
            self.index = TimeIndex(self.reader)
            self.description = self._description()
            self.notes: list[str] = []  # what the page cannot show, and why
            self.cell = self._cell()
            damage = Damage()
            story: dict[str, list[Record]] = {topic: [] for topic in _STORY}
            for record in self.reader.records(_STORY, damage=damage):
                story[record.topic].append(record)
        except GelflowError:
            self.reader.close()
            raise
        self.name = self.reader.path.name
        self.start, self.end = self.index.start, self.index.end  # robot time [s]
        self.marks: list[Mark] = marks(story["/event"], story["/attempt"], story["/decision"])
        self.decisions = story["/decision"]
        self._phases = phases(story["/event"])
        self._descents = [time for time, phase in self._phases if phase == "descend"]
        lab = self.description.get("lab") or {}
        self._settle = float(lab.get("descent", {}).get("settle", 0.0))  # rest before the reference images [s]
        self.markers = self.marker_reader()
        if self.markers.problem:
            self.notes.append(f"no markers are shown: {self.markers.problem}")

    def __enter__(self) -> "RecordedSession":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.reader.close()

    def _description(self) -> Mapping[str, Any]:
        """The description of the session; empty for recordings of `gelflow track`."""
        try:
            return self.reader.description()
        except PeerError:
            return {}

    def _cell(self) -> CellGeometry | None:
        """The geometry of the cell; None where the description lacks it."""
        if not self.description:
            return None
        try:
            return CellGeometry.of(self.description)
        except PeerError as error:
            self.notes.append(f"no robot is shown: {error}")
            return None

    def marker_reader(self) -> MarkerReader:
        """A new reader of the markers, for one thread."""
        return MarkerReader(self.index, self.description, self.reference_time)

    def reference_time(self, time: float) -> float:
        """The time of the images that displacements are shown relative to [s].

        In an attempt, and until the next one, the start of its descent at rest; before the first one the start of the
        session.
        """
        number = bisect_right(self._descents, time)
        if number == 0:
            return self.start
        return min(self._descents[number - 1] + self._settle, time)

    def at(self, time: float, *, markers: bool = True) -> Moment:
        """The measurements known at a robot time [s]; without `markers` the images are not tracked."""
        joints = self.index.latest("/arm/joints", time)
        flange = self.index.latest("/arm/pose", time)
        gripper = self.index.latest("/gripper/state", time)
        phase = bisect_right(self._phases, time, key=lambda entry: entry[0])
        attempt = next((m for m in self.marks if m.end > m.time and m.time <= time <= m.end), None)
        decision = next((r.value for r in reversed(self.decisions) if r.time <= time), None)
        return Moment(
            time=time,
            pads=tuple(self.markers.pad(sensor, time, track=markers) for sensor in range(len(SENSORS))),
            joints=tuple(joints.value.values()) if joints is not None else None,
            flange=flange.value if flange is not None and isinstance(flange.value, Pose) else None,
            gripper=gripper.value if gripper is not None else None,
            phase=self._phases[phase - 1][1] if phase else "",
            insertion=attempt.insertion if attempt else None,
            attempt=attempt.attempt if attempt else None,
            decision=decision,
        )
