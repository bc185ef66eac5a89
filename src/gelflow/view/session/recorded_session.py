"""A recorded session as moments: what was known at any time of it."""

from bisect import bisect_right
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from gelflow.errors import GelflowError, PeerError
from gelflow.geometry import Pose
from gelflow.session.live_reader import LiveReader
from gelflow.session.messages import Damage, has_topic
from gelflow.session.reader import Record, SessionReader, is_being_recorded, open_recording
from gelflow.session.records import SENSORS
from gelflow.session.time_index import TimeIndex
from gelflow.view.robot.cell_geometry import CellGeometry
from gelflow.view.session.marker_reader import MarkerReader
from gelflow.view.session.snapshot import Snapshot
from gelflow.view.session.timeline_events import TimelineEvent, descents, phases, timeline_events

_FORCE_AGE = 0.5  # of a force that is shown [s]
_EVENT_TOPICS = ("/event", "/attempt", "/decision")


class RecordedSession:
    """An open session file and its events. Use it as a context manager.

    Parameters
    ----------
    path: the file
    live: whether it is being recorded, None: find out; `refresh` then adds what has been recorded since

    Raises UsageError for a file that is no session, PeerError for one that is unfinished, damaged or empty.
    """

    def __init__(self, path: str | Path, *, live: bool | None = None) -> None:
        if live is None:
            with open_recording(Path(path)) as stream:
                live = is_being_recorded(stream)
        self._live = LiveReader(path).open() if live else None
        self.reader: SessionReader = self._live or SessionReader(path).open()
        try:
            self.index = TimeIndex(self.reader)
            self.description = self._description()
            self.notes: list[str] = []  # what the page cannot show, and why
            self.cell = self._cell()
            records = list(self.reader.records(_EVENT_TOPICS, damage=Damage()))
        except GelflowError:
            self.reader.close()
            raise
        self.name = self.reader.path.name
        self.growing = self._live is not None and not self._live.finished  # it is still being recorded
        self.start = self.index.start  # robot time [s]
        if "task" not in self.description:  # of `gelflow track`, whose description has no time
            self.start = min((record.time for record in self._first_images()), default=self.start)
        self.timeline_events: list[TimelineEvent] = []
        self.decisions: list[Record] = []
        self._event_records: list[Record] = []
        self._phases: list[tuple[float, str]] = []
        self._descents: list[float] = []
        self._add(records)
        lab = self.description.get("lab") or {}
        self._settle = float(lab.get("descent", {}).get("settle", 0.0))  # rest before the reference images [s]
        self.markers = self.marker_reader()
        if self.markers.problem:
            self.notes.append(f"no markers are shown: {self.markers.problem}")

    def __enter__(self) -> "RecordedSession":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.reader.close()

    @property
    def end(self) -> float:
        """Time of the last record, robot time [s]."""
        return self.index.end

    @property
    def first_view(self) -> float:
        """The first time at which both images and the arm are known, as far as they are recorded, robot time [s]."""
        arm = self.index.first("/arm/joints", self.start) if "/arm/joints" in self.index.topics() else None
        found = [*self._first_images(), *([] if arm is None else [arm])]
        return max((record.time for record in found), default=self.start)

    def _first_images(self) -> list[Record]:
        """The first image of each pad that has one."""
        topics = [f"/{sensor}/image" for sensor in SENSORS if f"/{sensor}/image" in self.index.topics()]
        found = [self.index.first(topic, self.index.start) for topic in topics]
        return [record for record in found if record is not None]

    def refresh(self) -> bool:
        """Add what has been recorded since the last call; whether there was anything. Only for live sessions."""
        if self._live is None:
            return False
        found = self._live.update()
        self.index.extend(found)
        added = []
        for chunk in found:
            if not has_topic(chunk, self._live.summary, _EVENT_TOPICS):
                continue
            messages = [entry for entry in self._live.chunk(chunk) if entry[0] in _EVENT_TOPICS]
            added += [self._live.record(topic, message) for topic, message in messages]
        if added:
            self._add(added)
        self.growing = not self._live.finished  # after the last records are added, for other threads
        return bool(found)

    def _add(self, records: list[Record]) -> None:
        """Add events, attempts and decisions."""
        self._event_records += records
        of_topic = {topic: [r for r in self._event_records if r.topic == topic] for topic in _EVENT_TOPICS}
        self._phases = phases(of_topic["/event"])
        self._descents = descents(self._phases)
        self.decisions = of_topic["/decision"]
        self.timeline_events = timeline_events(of_topic["/event"], of_topic["/attempt"], of_topic["/decision"])

    def _description(self) -> Mapping[str, Any]:
        """The description of the session; empty for recordings of `gelflow track`."""
        try:
            return self.reader.description()
        except PeerError:
            return {}

    def _cell(self) -> CellGeometry | None:
        """The geometry of the cell; None where the description lacks it."""
        if "task" not in self.description:
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

    def at(self, time: float, *, markers: bool = True) -> Snapshot:
        """The measurements known at a robot time [s]; without `markers` the images are not tracked."""
        joints = self.index.latest("/arm/joints", time)
        flange = self.index.latest("/arm/pose", time)
        gripper = self.index.latest("/gripper/state", time)
        checks = self.index.latest("/checks", time)
        phase = bisect_right(self._phases, time, key=lambda entry: entry[0])
        attempt = next((m for m in self.timeline_events if m.end > m.time and m.time <= time <= m.end), None)
        decision = next((r.value for r in reversed(self.decisions) if r.time <= time), None)
        return Snapshot(
            time=time,
            pads=tuple(self.markers.pad(sensor, time, track=markers) for sensor in range(len(SENSORS))),
            joints=tuple(joints.value.values()) if joints is not None else None,
            flange=flange.value if flange is not None and isinstance(flange.value, Pose) else None,
            gripper=gripper.value if gripper is not None else None,
            phase=self._phases[phase - 1][1] if phase else "",
            insertion=attempt.insertion if attempt else None,
            attempt=attempt.attempt if attempt else None,
            decision=decision,
            checks=tuple(checks.value["checks"]) if checks is not None else (),
            forces=tuple(self._force(sensor, time) for sensor in SENSORS),
        )

    def _force(self, sensor: str, time: float) -> Mapping[str, Any] | None:
        """The force on a pad at a time [s]; None where it was not estimated, for example while nothing was held."""
        record = self.index.latest(f"/{sensor}/force", time)
        return record.value if record is not None and time - record.time < _FORCE_AGE else None
