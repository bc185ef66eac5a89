"""A short session with rendered gel images: two attempts, the first of them with contact."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tests.common.manual_clock import ManualClock

from gelflow.observation import FlowMap
from gelflow.perception.frames import CameraMount
from gelflow.perception.synthetic.appearance import GelAppearance
from gelflow.perception.synthetic.fast_renderer import FastGelRenderer
from gelflow.protocols import ArmState, CameraImage, GripperState
from gelflow.real.kinematics import forward
from gelflow.session import Decision, SessionRecorder, describe_session
from gelflow.task import INSERTION

SECONDS = 12.0
STEP = 0.1  # [s]
CONTACT = (5.0, 7.0)  # of the first attempt [s]
SHEAR = 0.2  # [mm] during the contact, along the finger
LOOK = GelAppearance()
MOUNT = CameraMount(pixels_per_mm=LOOK.pixels_per_mm)
HOLE_HEIGHT, GRASP_HEIGHT = 0.05, 0.03  # [m]
LAB = {
    "tool": {"position": [0.0, 0.0, 0.18], "quaternion": [0.0, 1.0, 0.0, 0.0]},
    "hole": {"position": [0.374, 0.05, HOLE_HEIGHT], "yaw_deg": 0.0},
    "part": {"grasp_height": GRASP_HEIGHT},
    "gripper": {"open_width": 0.06},
    "descent": {"settle": 0.5},
}
JOINTS = np.array([0.13, 0.55, 0.1, 0.0, 0.9, 0.13])


def joints_at(seconds: float) -> NDArray[np.float64]:
    """Joint angles [rad], `shift` seconds before a time of the recording."""
    return JOINTS + seconds * np.array([0.0, 0.02, 0.0, 0.0, -0.02, 0.0])


def make_session(path: Path, *, shift: float = 0.0, start: float = 100.0) -> None:
    """Record the session in robot time from `start`; all events `shift` seconds later than the contact images."""
    clock = ManualClock(start)
    renderers = [FastGelRenderer(LOOK) for _ in range(2)]
    rest = np.zeros_like(LOOK.positions_mm())
    moved = rest + np.array([SHEAR, 0.0])
    rng = np.random.default_rng(0)
    with SessionRecorder(path, clock) as recorder:
        recorder.metadata(
            describe_session(task=INSERTION, trackers=[MOUNT.tracker_config()] * 2, mounts=[MOUNT] * 2, lab=LAB)
        )
        for number in range(round(SECONDS / STEP)):
            clock.time = start + number * STEP
            seconds = number * STEP - shift
            touching = CONTACT[0] <= seconds < CONTACT[1]
            for sensor, renderer in enumerate(renderers):
                picture = renderer.render(moved if touching else rest, sequence=number)
                recorder.image(sensor, CameraImage(renderer.encode(picture), clock.time, number))
            joints = joints_at(seconds)
            position, quaternion = forward(joints.tolist())
            recorder.arm_state(
                ArmState(np.array(position), np.array(quaternion), joints, clock.time, True, True, "auto")
            )
            grasp = "holding" if seconds > 1 else "idle"
            width = 0.035 if seconds > 1 else 0.06
            recorder.gripper_state(GripperState(width, 0.0, 12.0 * (seconds > 1), True, grasp, "", clock.time))
            _record_events(recorder, number - round(shift / STEP), rng)


def _record_events(recorder: SessionRecorder, number: int, rng: np.random.Generator) -> None:
    if number == 30:
        recorder.event("state", {"state": "descend"})
    if number == 60:
        recorder.event("pad not readable", {"camera": "left", "seconds": 0.3})
    if number == 70:
        grid = INSERTION.grid
        flow = rng.uniform(-0.7, 0.7, size=(4, grid.rows, grid.cols)).astype(np.float32)
        decision = Decision.of(
            FlowMap(flow, 0.2, "mm", np.zeros((2, grid.rows, grid.cols), dtype=bool)),
            insertion=0, attempt=0, tracked=((30, 70), (30, 70)), reference=(30, 30), frames=((70, 70),),
            action=np.array([1e-3, -2e-3, 0.05]), correction=np.zeros(3),
        )  # fmt: skip
        recorder.decision(decision.to_json())
        recorder.attempt_end({"insertion": 0, "attempt": 0, "outcome": "not inserted"})
        recorder.event("state", {"state": "retreat"})
    if number == 85:
        recorder.event("state", {"state": "descend"})
    if number == 110:
        recorder.attempt_end({"insertion": 0, "attempt": 1, "outcome": "inserted"})
