"""Latency of the cameras of a recorded run, from its grasps."""

from collections.abc import Sequence
from dataclasses import dataclass

from gelflow.perception.tracker import TrackerConfig
from gelflow.real.camera.latency import LatencyEstimate
from gelflow.real.runner.touch.grasp_latency import GraspSignals
from gelflow.session.messages import Damage
from gelflow.session.reader import SessionReader
from gelflow.session.records import SENSORS

_BEFORE = 0.1  # of a grasp, from which its data are used [s]
_AFTER = 0.3  # after the part is held [s]
_LONGEST = 10.0  # a grasp that takes longer is not used [s]


@dataclass
class _Grasp:
    """One grasp, and its signals."""

    start: float
    end: float
    signals: GraspSignals


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
                grasp.signals.images.setdefault(sensor, []).append(record.value)
    found: list[list[LatencyEstimate]] = [[] for _ in trackers]
    for grasp in grasps:
        for known, estimate in zip(found, grasp.signals.latencies(trackers), strict=True):
            known += [] if estimate is None else [estimate]
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
            grasps[-1].signals.force.append((record.stamp, value))
        elif started is not None:
            force.append((record.stamp, value))
            if record.value["grasp"] == "holding" and record.stamp - started < _LONGEST:
                grasps.append(_Grasp(started, record.stamp + _AFTER, GraspSignals(force)))
                started = None
    return grasps
