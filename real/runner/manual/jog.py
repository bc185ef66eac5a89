"""Jogging: bounded straight motions of the gripper frame, checked by the supervisor, upward before anything else."""

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gelflow import interrupts
from gelflow.errors import GelflowError, SafetyError, UsageError
from gelflow.geometry import Pose, yaw_quaternion
from gelflow.real.camera.stream import StreamCamera
from gelflow.real.egm.driver import EgmArm
from gelflow.real.limits import LIMITS
from gelflow.real.runner.cell import StopArm, connect_camera, controller_monitor, egm_config, gripper_of
from gelflow.real.runner.manual.gripper_actions import state_without_fault
from gelflow.real.runner.manual.question import Result, Session
from gelflow.real.runner.motion_executor import MotionExecutor
from gelflow.real.runner.phases import Phase
from gelflow.real.runner.supervisor import Supervisor, not_ready_reason
from gelflow.real.runner.touch.grasp_check import nominal_thresholds
from gelflow.real.runner.touch.guarded_motion import GuardedMotion, in_any_direction
from gelflow.real.runner.touch.observer import TactileObserver
from gelflow.real.web_services.monitor import ControllerMonitor
from gelflow.real.wsg.checks import may_hold_part
from gelflow.real.wsg.driver import WsgGripper
from gelflow.session.recorder import SessionRecorder
from gelflow.session.records import SENSORS

Axis = Literal["x", "y", "z", "yaw", "load"]
_FOLLOW_TIMEOUT = 3.0  # for the controller to follow references [s]
_CLOSE = (1e-4, math.radians(0.1))  # a motion below these is omitted [m, rad]


@dataclass(frozen=True)
class Jog:
    """One jog: `amount` along x, y or z of the gripper frame [m] or about its z axis [rad], or to the hand-over."""

    axis: Axis
    amount: float = 0.0

    def __post_init__(self) -> None:
        turn = self.axis == "yaw"
        limit = math.radians(LIMITS.jog_turn_deg) if turn else LIMITS.jog_distance
        # The comparison is false for NaN.
        if self.axis != "load" and not 0 < abs(self.amount) <= limit * (1 + 1e-9):
            shown = f"±{LIMITS.jog_turn_deg:g}°" if turn else f"±{1e3 * limit:g} mm"
            given = f"{math.degrees(self.amount):g}°" if turn else f"{1e3 * self.amount:g} mm"
            raise UsageError(f"a jog in {self.axis} must be within {shown} and not 0, got {given}")


@dataclass(frozen=True)
class _Step:
    """One straight motion."""

    text: str
    target: Pose
    upward: bool


@dataclass(frozen=True)
class _Devices:
    arm: EgmArm
    gripper: WsgGripper
    cameras: list[StreamCamera]
    controller: ControllerMonitor | None
    blind: str  # why the pads cannot be observed; empty when they can


def jog(session: Session, wanted: Jog) -> Result:
    """Move the gripper. Below the height of the hand-over it is first raised to it, unless the motion is along z.

    A part that may be held is moved only while both pads are observed, and stops at contact; without an image it can
    only be raised. Raises SafetyError when a target is refused or the gripper reports a fault, PeerError when a device
    fails.
    """
    lab = session.lab
    with contextlib.ExitStack() as stack:
        devices = stack.enter_context(_open(session))
        supervisor = Supervisor(lab)
        held = may_hold_part(state_without_fault(devices.gripper), grasped=False)
        before = _arm_pose(session, devices)
        steps = _steps(session, supervisor, before, wanted)
        if not steps:
            session.say("the gripper is there already")
            return {"done": True, "from": _coordinates(supervisor, before)}
        for step in steps:
            if held and devices.blind and not step.upward:
                raise SafetyError(
                    f"{step.text} refused: a held part is only raised while a pad is not observed ({devices.blind}); "
                    "raise it with: gelflow robot jog z +10, or release it with: gelflow robot open"
                )
        result: Result = {"done": False, "from": _coordinates(supervisor, before), "steps": [s.text for s in steps]}
        if session.recorder is None:
            session.agreed(f"{'; then '.join(step.text for step in steps)}. Move?", devices.gripper.state)
            return result
        motion = _executor(session, devices, supervisor, session.recorder)
        session.on_motion(motion)
        with motion:
            for step in steps:
                if not session.agreed(f"{step.text}. Move?", lambda: motion.wait(0.0)):
                    break
                _move(session, devices, motion, step, held=held)
            else:
                result["done"] = True
            result["to"] = _coordinates(supervisor, motion.pose())
        return result


@contextlib.contextmanager
def _open(session: Session) -> Iterator[_Devices]:
    """Connect gripper, arm, and the cameras that answer; at the exit, stop the arm and disconnect."""
    lab, clock = session.lab, session.clock
    with contextlib.ExitStack() as stack:
        stack.callback(interrupts.resume)
        interrupts.defer()
        # The gripper does not move here: nothing is sent to it, and no stop ends its grip.
        gripper = stack.enter_context(gripper_of(lab, clock, session.recorder, dry_run=True))
        cameras: list[StreamCamera] = []
        blind = ""
        for name in SENSORS:
            try:
                camera = stack.enter_context(connect_camera(lab, clock, name, session.recorder))
                camera.next(-1, lab.limits.stale_frame)
                cameras.append(camera)
            except GelflowError as error:
                blind = blind or str(error)
        controller = stack.enter_context(controller_monitor(lab, clock)) if lab.arm.web_services else None
        arm = EgmArm(egm_config(lab, dry_run=session.dry_run), clock=clock)
        stack.callback(arm.close)
        arm.connect()
        if session.recorder is not None:
            stack.enter_context(StopArm(arm, session.recorder))
        interrupts.resume()
        stack.callback(interrupts.defer)
        yield _Devices(arm, gripper, [] if blind else cameras, controller, blind)


def _arm_pose(session: Session, devices: _Devices) -> Pose:
    """Pose of the gripper frame. Raises PeerError or SafetyError when the arm is not ready to move."""
    arm = devices.arm
    if devices.controller is not None:
        devices.controller.approve()
    if not session.dry_run:
        arm.wait_following(_FOLLOW_TIMEOUT)
    state = arm.state()
    reason = not_ready_reason(state)
    if reason and not (session.dry_run and state.motors_on and not state.fault):
        raise SafetyError(reason)
    return session.lab.gripper_pose(state.position, state.quaternion)


def _steps(session: Session, supervisor: Supervisor, here: Pose, wanted: Jog) -> list[_Step]:
    """The motions of a jog, each checked relative to the one before. Raises SafetyError when one is refused."""
    load = session.lab.part.load_height
    here = supervisor.within_workspace(here)
    height = supervisor.hole_coordinates(here)[3]
    poses: list[tuple[str, Pose]] = []
    if wanted.axis == "load":
        level = max(height, load)
        poses = [
            ("raise the gripper", _moved(here, z=level - height)),
            ("move it above the taught hole", session.lab.gripper_at(0.0, 0.0, 0.0, level)),
            ("lower it to the hand-over", session.lab.gripper_at(0.0, 0.0, 0.0, load)),
        ]
    else:
        sideways = wanted.axis != "z" and height < load - _CLOSE[0]
        raised = _moved(here, z=load - height) if sideways else here
        if sideways:
            poses.append(("raise the gripper to the hand-over first", raised))
        amount = f"{math.degrees(wanted.amount):+g}°" if wanted.axis == "yaw" else f"{1e3 * wanted.amount:+g} mm"
        poses.append((f"jog {wanted.axis} {amount}", _moved(raised, **{wanted.axis: wanted.amount})))
    steps, before = [], here
    for text, target in poses:
        if not target.is_near(before, *_CLOSE):
            speed = min(LIMITS.jog_speed, session.lab.arm.max_speed)
            turn_speed = math.radians(session.lab.arm.max_turn_speed_deg)
            supervisor.check(target, before, speed=speed, turn_speed=turn_speed)
            new = supervisor.hole_coordinates(target)
            shown = f"{text}: to x {1e3 * new[0]:+.1f}, y {1e3 * new[1]:+.1f}, height {1e3 * new[3]:.1f} mm"
            upward = bool(np.allclose(target.position[:2], before.position[:2], atol=_CLOSE[0])) and bool(
                target.position[2] > before.position[2]
            )
            steps.append(_Step(f"{shown}, yaw {math.degrees(new[2]):+.1f}°", target, upward))
            before = target
    return steps


def _moved(pose: Pose, *, x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> Pose:
    """`pose` moved in its own frame."""
    return pose @ Pose(np.array([x, y, z]), yaw_quaternion(yaw))


def _coordinates(supervisor: Supervisor, pose: Pose) -> dict[str, float]:
    x, y, yaw, height = supervisor.hole_coordinates(pose)
    return {"x": x, "y": y, "height": height, "yaw_deg": math.degrees(yaw)}


def _executor(session: Session, devices: _Devices, supervisor: Supervisor, recorder: SessionRecorder) -> MotionExecutor:
    for phase in (Phase.PREFLIGHT, Phase.LOAD):
        supervisor.phases.enter(phase)
    return MotionExecutor(
        devices.arm,
        devices.gripper,
        devices.cameras,
        lab=session.lab,
        clock=session.clock,
        supervisor=supervisor,
        recorder=recorder,
        controller=devices.controller,
    )


def _move(session: Session, devices: _Devices, motion: MotionExecutor, step: _Step, *, held: bool) -> None:
    """Execute a step; a held part is observed, and moves until contact. Raises SafetyError at contact."""
    lab, recorder = session.lab, session.recorder
    assert recorder is not None
    speed = min(LIMITS.jog_speed, lab.arm.max_speed)
    if not held or devices.blind:
        motion.move(step.target, speed=speed)
        return
    mounts = (lab.cameras.left.mount, lab.cameras.right.mount)
    observer = TactileObserver(devices.cameras, mounts, clock=session.clock, stale=lab.limits.stale_frame)
    observer.start(session.clock.now())
    observer.at_rest(session.clock.now())  # the image period limits the speed
    guard = GuardedMotion(motion, observer, lab, session.clock, recorder)
    motion.expect_part(True)
    phases = motion.supervisor.phases
    sideways = Phase.APPROACH if phases.phase in (Phase.LOAD, Phase.APPROACH) else Phase.CORRECT
    phases.enter(Phase.RETREAT if step.upward else sideways)
    thresholds = nominal_thresholds(lab.descent)
    threshold = thresholds.stuck if step.upward else thresholds.stop
    speed = min(speed, guard.speed_towards(step.target))
    contact = guard.move(step.target, threshold=threshold, measure=in_any_direction, speed=speed)
    if contact is not None:
        raise SafetyError(
            f"stopped by contact: the mean shear of a pad changed by {contact.change:.3f} mm, more than "
            f"{threshold:g} mm; look at the part, and release it with: gelflow robot open"
        )
