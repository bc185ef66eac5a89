"""State of all devices of a cell, read without sending any motion byte."""

import math
from collections.abc import Callable
from typing import Any

from gelflow.clock import ScaledClock
from gelflow.errors import GelflowError
from gelflow.real.egm.driver import EgmArm
from gelflow.real.runner.cell import connect_camera, controller_monitor, egm_config, gripper_of
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.supervisor import Supervisor

_OBSERVED = 1.0  # time over which the rate of a camera is measured [s]


def read_status(lab: Lab) -> dict[str, dict[str, Any]]:
    """State of "arm", "gripper", "left camera" and "right camera", each with "ready" and "text".

    With `arm.web_services` in the lab file also "controller": its operating mode and program. A device that does not
    answer has an "error" instead of its values. References, motions and stops are not sent.
    """
    clock = lab.clock
    readers: dict[str, Callable[[], dict[str, Any]]] = {
        "arm": lambda: _arm(lab, clock),
        "gripper": lambda: _gripper(lab, clock),
        "left camera": lambda: _camera(lab, clock, "left"),
        "right camera": lambda: _camera(lab, clock, "right"),
    }
    if lab.arm.web_services:
        readers["controller"] = lambda: _controller(lab, clock)
    return {name: _read(reader) for name, reader in readers.items()}


def _read(reader: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    try:
        return reader()
    except GelflowError as error:
        return {"ready": False, "text": str(error), "error": str(error)}


def _arm(lab: Lab, clock: ScaledClock) -> dict[str, Any]:
    with EgmArm(egm_config(lab, dry_run=True), clock=clock) as arm:
        state = arm.state()
        motors_on, following = state.motors_on, state.running
    x, y, yaw, height = Supervisor(lab).hole_coordinates(lab.gripper_pose(state.position, state.quaternion))
    position = f"x {1e3 * x:+.1f}, y {1e3 * y:+.1f}, height {1e3 * height:.1f} mm, yaw {math.degrees(yaw):+.1f}°"
    motors = f"motors {'on' if motors_on else 'off'}"
    follows = "follows references" if following else "follows no references (none are sent)"
    return {
        "ready": motors_on,
        "text": f"{motors}, {follows}; {position} about the hole",
        "motors_on": motors_on,
        "following": following,
        "x": x,
        "y": y,
        "height": height,
        "yaw_deg": math.degrees(yaw),
        "joints_deg": [math.degrees(angle) for angle in state.joints],
    }


def _controller(lab: Lab, clock: ScaledClock) -> dict[str, Any]:
    with controller_monitor(lab, clock) as monitor:
        state = monitor.approve()
    return {"ready": True, "text": str(state), "operating_mode": state.operating_mode}


def _gripper(lab: Lab, clock: ScaledClock) -> dict[str, Any]:
    with gripper_of(lab, clock, None, dry_run=True) as gripper:
        state = gripper.state()
    homed = "homed" if state.referenced else "not homed"
    fault = f"fault {state.fault}" if state.fault else "no fault"
    return {
        "ready": state.referenced and not state.fault,
        "text": f"{homed}, {fault}, {state.grasp}, {1e3 * state.width:.1f} mm open, {state.force:.1f} N",
        "referenced": state.referenced,
        "fault": state.fault,
        "grasp": state.grasp,
        "width": state.width,
        "force": state.force,
    }


def _camera(lab: Lab, clock: ScaledClock, name: str) -> dict[str, Any]:
    with connect_camera(lab, clock, name, None) as camera:
        first, begun = camera.next(-1, lab.limits.stale_frame), clock.now()
        clock.sleep(_OBSERVED)
        last, ended = camera.latest(), clock.now()
    rate, age = (last.sequence - first.sequence) / (ended - begun), ended - last.stamp
    return {
        "ready": rate > 0,
        "text": f"{rate:.1f} images/s, the newest {1e3 * age:.0f} ms old",
        "rate": rate,
        "age": age,
    }
