"""Preflight: checks all devices before any motion, and reports all failed checks together."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from gelflow.errors import GelflowError, PeerError, SafetyError
from gelflow.perception.frames import CameraMount, decode_image
from gelflow.perception.mount_check import start_at_rest, visible_text
from gelflow.real.runner.cell import Cell
from gelflow.real.runner.supervisor import Supervisor, not_ready_reason
from gelflow.real.wsg.checks import may_hold_part

_COMPARED_IMAGES = 3  # consecutive images of each camera
_FOLLOW_TIMEOUT = 3.0  # for the controller to follow references [s]


@dataclass(frozen=True)
class PreflightItem:
    """The result of one check."""

    name: str
    good: bool
    text: str  # the measured state, or the error


def run_preflight(cell: Cell, supervisor: Supervisor) -> list[PreflightItem]:
    """Check cameras, arm and gripper. Only when all checks pass, homes the gripper outwards if the lab file allows it.

    Returns all results. Raises SafetyError, which names every failed check.
    """
    lab = cell.lab
    mounts = (lab.cameras.left.mount, lab.cameras.right.mount)
    cameras: list[tuple[str, Callable[[], str]]] = [
        ("left camera", lambda: _camera(cell, 0, mounts[0])),
        ("right camera", lambda: _camera(cell, 1, mounts[1])),
    ]
    robot: list[tuple[str, Callable[[], str]]] = [
        ("arm", lambda: _arm(cell)),
        ("pose", lambda: _pose(cell, supervisor)),
        ("gripper", lambda: _gripper(cell)),
    ]
    # The gripper is homed last. A controller whose messages are not answered, as in a dry run, soon ends EGM.
    checks = [*robot, *cameras] if cell.dry_run else [*cameras, *robot]
    items = [_result(name, check) for name, check in checks]
    if all(item.good for item in items) and not cell.dry_run:
        items[-1] = _result("gripper", lambda: _homed(cell, supervisor))
    cell.recorder.event("preflight", {item.name: {"good": item.good, "text": item.text} for item in items})
    if failed := [f"{item.name}: {item.text}" for item in items if not item.good]:
        raise SafetyError(f"preflight failed: {'; '.join(failed)}")
    return items


def _result(name: str, check: Callable[[], str]) -> PreflightItem:
    try:
        return PreflightItem(name, True, check())
    except GelflowError as error:
        return PreflightItem(name, False, str(error))


def _camera(cell: Cell, sensor: int, mount: CameraMount) -> str:
    if sensor > 0:
        _check_distinct(cell)
    image = cell.cameras[sensor].latest()
    age = cell.clock.now() - image.stamp  # before the search for markers, which takes a second
    picture = decode_image(image.data)
    if mount.calibration is not None:
        mount.calibration.check_size(picture)
    tracked = start_at_rest(mount, picture)
    return f"{visible_text(mount, tracked)}; newest image {1e3 * age:.0f} ms old"


def _check_distinct(cell: Cell) -> None:
    """Raise PeerError when both cameras deliver an identical image: sensor noise makes those of two cameras differ."""
    newest = [-1, -1]
    seen: tuple[set[bytes], set[bytes]] = set(), set()
    for _ in range(_COMPARED_IMAGES):
        for sensor, camera in enumerate(cell.cameras):
            image = camera.next(newest[sensor], camera.timeout)
            newest[sensor] = image.sequence
            seen[sensor].add(image.data)
    if seen[0] & seen[1]:
        raise PeerError(
            "it delivers the same images as the left camera: correct the sources in the lab file, each finger has its "
            "own camera"
        )


def _arm(cell: Cell) -> str:
    if not cell.dry_run:
        cell.arm.wait_following(_FOLLOW_TIMEOUT)
    state = cell.arm.state()
    age = cell.clock.now() - state.stamp
    if age > cell.lab.limits.stale_pose:
        raise PeerError(f"the newest pose is {1e3 * age:.0f} ms old")
    # In a dry run no message is answered, so the controller does not follow; all other conditions must hold.
    if (reason := not_ready_reason(state)) and not (cell.dry_run and state.motors_on and not state.fault):
        raise SafetyError(reason)
    following = "following" if state.running else "not following (dry run)"
    if cell.controller is None:
        return f"motors on, mode unknown (no web_services in the lab file), {following}"
    return f"{cell.controller.approve()}, {following}"


def _pose(cell: Cell, supervisor: Supervisor) -> str:
    state = cell.arm.state()
    pose = cell.lab.gripper_pose(state.position, state.quaternion)
    x, y, yaw, height = supervisor.hole_coordinates(pose)
    try:
        supervisor.check(supervisor.within_workspace(pose), pose, speed=1e-6, turn_speed=1e-6)
    except SafetyError as error:
        raise SafetyError(f"{error}; jog the gripper above the hole") from None
    turn = math.degrees(yaw)
    return f"x {1e3 * x:+.1f}, y {1e3 * y:+.1f}, height {1e3 * height:.1f} mm, yaw {turn:+.1f}° about the hole"


def _gripper(cell: Cell) -> str:
    state = cell.gripper.state()
    if state.fault:
        raise PeerError(f"it reports {state.fault}; inspect it and acknowledge the fault")
    if may_hold_part(state, grasped=False):
        raise SafetyError(
            f"a part may be held ({state.grasp}, {state.force:.1f} N); hold it and release it with: gelflow robot open"
        )
    if state.referenced:
        return f"homed, {state.grasp}, {1e3 * state.width:.1f} mm open"
    if not cell.lab.gripper.home_at_start:
        raise SafetyError("it is not homed: home it outwards, or set home_at_start in the lab file")
    return "not homed: a run homes it outwards after these checks"


def _homed(cell: Cell, supervisor: Supervisor) -> str:
    if supervisor.latched:  # the stop button
        raise SafetyError(f"not homed: {supervisor.latched}")
    if not cell.gripper.state().referenced:
        cell.gripper.home()
    return _gripper(cell)
