"""Curves over the time of a session: height of the part, shear of both pads, grip force, normal force of the pads."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gelflow.geometry import Pose
from gelflow.session.reader import Record
from gelflow.session.records import SENSORS
from gelflow.session.time_index import refining_order
from gelflow.view.session.recorded_session import RecordedSession

Array = NDArray[np.float64]
SAMPLES = 500  # of a curve in the shown time
_PER_ROUND = 10  # samples between two yields
ARM, GRIPPER = "/arm/pose", "/gripper/state"  # topics
FORCES = tuple(f"/{sensor}/force" for sensor in SENSORS)


@dataclass
class Curve:
    """Samples of one quantity, in any order."""

    label: str
    samples: list[tuple[float, float]] = field(default_factory=list)  # robot time [s] and value

    def ordered(self) -> tuple[Array, Array]:
        """Times [s] and values, in order of time."""
        values = np.array(sorted(self.samples), dtype=float).reshape(-1, 2)
        return values[:, 0], values[:, 1]


@dataclass
class Curves:
    """The curves of the time from `start` to `end` [s]."""

    start: float
    end: float
    height: Curve = field(default_factory=lambda: Curve("height of the part [mm]"))
    shear: tuple[Curve, ...] = field(
        default_factory=lambda: tuple(Curve(f"{sensor} pad") for sensor in SENSORS)
    )  # [mm], or length of the displacements [px], see `MarkerReader.shear`
    shear_in_millimetres: bool = True
    force: Curve = field(default_factory=lambda: Curve("gripper"))  # [N]
    normal: tuple[Curve, ...] = field(
        default_factory=lambda: tuple(Curve(f"{sensor} pad") for sensor in SENSORS)
    )  # force of pads with a gel [N]
    gross_slip: Curve = field(default_factory=lambda: Curve("gross slip"))  # normal force of a pad in gross slip [N]

    def add(self, later: "Curves") -> None:
        """Append the samples of the time that follows."""
        for own, added in zip(self._all(), later._all(), strict=True):
            own.samples += added.samples
        self.end = later.end

    def _all(self) -> tuple[Curve, ...]:
        return self.height, *self.shear, self.force, *self.normal, self.gross_slip


def read_curves(session: RecordedSession, curves: Curves, *, samples: int = SAMPLES) -> Iterator[None]:
    """Add the samples of a session to `curves`; yields after some of them, first evenly spread over the time."""
    markers = session.marker_reader()
    curves.shear_in_millimetres = markers.in_millimetres
    records = session.index.spread([ARM, GRIPPER, *FORCES], curves.start, curves.end, samples)
    times = np.linspace(curves.start, curves.end, samples + 1)[1:]
    order = list(refining_order(samples))
    for number in range(samples):
        for record in next(records, []):
            _add_record(session, curves, record)
        time = float(times[order[number]])
        for sensor, curve in enumerate(curves.shear):
            shear = markers.shear(sensor, time)
            if np.isfinite(shear):
                curve.samples.append((time, shear))
        if number % _PER_ROUND == _PER_ROUND - 1:
            yield


def _add_record(session: RecordedSession, curves: Curves, record: Record) -> None:
    if isinstance(record.value, Pose):
        height = record.value.position[2] if session.cell is None else session.cell.part_height(record.value)
        curves.height.samples.append((record.time, 1e3 * float(height)))
    elif record.topic in FORCES:
        normal = record.time, float(record.value["normal"])
        curves.normal[FORCES.index(record.topic)].samples.append(normal)
        if record.value.get("gross_slip"):
            curves.gross_slip.samples.append(normal)
    else:
        curves.force.samples.append((record.time, float(record.value["force"])))
