"""Latency of the cameras of a recorded run, from its grasps."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from gelflow.errors import GelflowError
from gelflow.perception.frames import decode_image
from gelflow.perception.tracker import MarkerTracker, TrackerConfig
from gelflow.real.camera.latency import LatencyEstimate, estimate_latency
from gelflow.session.messages import Damage
from gelflow.session.reader import SessionReader
from gelflow.session.records import SENSORS

_BEFORE = 0.1  # of a grasp, from which its data are used [s]
_AFTER = 0.3  # after the part is held [s]
_LONGEST = 10.0  # a grasp that takes longer is not used [s]


@dataclass
class _Grasp:
    """One grasp, and its data."""

    start: float
    end: float
    force: list[tuple[float, float]] = field(default_factory=list)  # stamp [s], force [N]
    change: list[list[tuple[float, float]]] = field(default_factory=lambda: [[] for _ in SENSORS])  # stamp [s], [px]
    trackers: dict[int, MarkerTracker] = field(default_factory=dict)


def session_latencies(session: SessionReader, trackers: Sequence[TrackerConfig]) -> list[list[LatencyEstimate]]:
    """For each camera, the estimates of all grasps of `session` in which the contact is visible.

    `trackers` are the tracker settings of each sensor. Damaged records are passed over.
    """
    grasps = _grasps(session)
    topics = [f"/{sensor}/image" for sensor in SENSORS[: len(trackers)]] if grasps else []
    for record in session.records(topics, damage=Damage()) if topics else ():
        sensor = topics.index(record.topic)
        for grasp in grasps:
            if grasp.start <= record.stamp <= grasp.end:
                _add_image(grasp, sensor, trackers[sensor], record.stamp, record.value.data)
    found: list[list[LatencyEstimate]] = [[] for _ in trackers]
    for grasp in grasps:
        for estimates, change in zip(found, grasp.change, strict=False):
            if grasp.force and change:
                estimate = estimate_latency(*zip(*grasp.force, strict=True), *zip(*change, strict=True))
                estimates += [] if estimate is None else [estimate]
    return found


def _grasps(session: SessionReader) -> list[_Grasp]:
    """The grasps that ended with a held part, with the measured force."""
    grasps: list[_Grasp] = []
    started: float | None = None
    force: list[tuple[float, float]] = []
    for record in session.records(["/gripper/command", "/gripper/state"], damage=Damage()):
        if record.topic == "/gripper/command":
            started = record.stamp - _BEFORE if record.value["name"] == "grasp" else None
            force = []
            continue
        value = float(record.value["force"])  # a string for NaN
        if grasps and record.stamp <= grasps[-1].end:
            grasps[-1].force.append((record.stamp, value))
        elif started is not None:
            force.append((record.stamp, value))
            if record.value["grasp"] == "holding" and record.stamp - started < _LONGEST:
                grasps.append(_Grasp(started, record.stamp + _AFTER, force))
                started = None
    return grasps


def _add_image(grasp: _Grasp, sensor: int, config: TrackerConfig, stamp: float, data: bytes) -> None:
    """Track an image of a grasp and add the mean length of its marker displacements; unreadable images are omitted."""
    try:
        pixels = decode_image(data)
        tracker = grasp.trackers.get(sensor)
        if tracker is None:
            tracker = MarkerTracker(config)
            tracker.start(pixels)
            grasp.trackers[sensor] = tracker
        result = tracker.track(pixels)
    except GelflowError:
        return
    lengths = np.hypot(*result.displacement[result.valid].T)
    if lengths.size:
        grasp.change[sensor].append((stamp, float(lengths.mean())))
