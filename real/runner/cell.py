"""A robot cell that a lab file describes: connects all devices, records their data, disconnects in a safe order."""

import contextlib
import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import TracebackType

import numpy as np

from gelflow import interrupts
from gelflow.clock import ScaledClock
from gelflow.errors import GelflowError
from gelflow.protocols import CameraImage, Gripper, GripperState
from gelflow.real.camera.driver import open_camera
from gelflow.real.camera.stream import StreamCamera
from gelflow.real.egm.config import EgmConfig
from gelflow.real.egm.driver import EgmArm
from gelflow.real.limits import LIMITS
from gelflow.real.runner.lab import CameraSettings, Lab
from gelflow.real.runner.motion_executor import record_events
from gelflow.real.runner.touch.grasp_latency import LatencyMonitor
from gelflow.real.transport import transport_for
from gelflow.real.web_services.client import WebServicesClient
from gelflow.real.web_services.monitor import ControllerMonitor
from gelflow.real.wsg.config import WsgConfig
from gelflow.real.wsg.driver import WsgGripper
from gelflow.session.recorder import SessionRecorder
from gelflow.session.records import SENSORS

# The EGM driver's workspace box is larger than the workspace by this margin [m]; the supervisor's check is tighter.
_MARGIN = 2e-3


@dataclass(frozen=True)
class Cell:
    """A connected cell. Nothing has moved yet."""

    lab: Lab
    clock: ScaledClock
    arm: EgmArm
    gripper: Gripper
    cameras: tuple[StreamCamera, StreamCamera]  # of the left and of the right finger
    recorder: SessionRecorder
    latency: LatencyMonitor
    dry_run: bool
    controller: ControllerMonitor | None = None  # with `arm.web_services` in the lab file


@contextlib.contextmanager
def open_cell(lab: Lab, recorder: SessionRecorder, *, dry_run: bool = False) -> Iterator[Cell]:
    """Connect cameras, gripper and arm; at the exit, stop the arm, then disconnect the gripper, then the cameras.

    `recorder` must be open and is not closed. Raises PeerError or UsageError of the driver when a device cannot be
    reached; the devices opened before are closed again.
    """
    clock = lab.clock
    with contextlib.ExitStack() as stack:
        # A signal between the opening of a device and its registration would leave the device open.
        stack.callback(interrupts.resume)
        interrupts.defer()
        mounts = (lab.cameras.left.mount, lab.cameras.right.mount)
        configs = [mount.tracker_config() for mount in mounts]
        latency = LatencyMonitor(SENSORS, configs, clock_factor=lab.clock_factor)
        left = stack.enter_context(connect_camera(lab, clock, "left", recorder, latency))
        right = stack.enter_context(connect_camera(lab, clock, "right", recorder, latency))
        gripper = stack.enter_context(gripper_of(lab, clock, recorder, latency, dry_run=dry_run))
        controller = stack.enter_context(controller_monitor(lab, clock)) if lab.arm.web_services else None
        arm = EgmArm(egm_config(lab, dry_run=dry_run), clock=clock)
        stack.callback(arm.close)
        arm.connect()
        stack.enter_context(StopArm(arm, recorder))
        interrupts.resume()
        stack.callback(interrupts.defer)
        yield Cell(lab, clock, arm, gripper, (left, right), recorder, latency, dry_run, controller)


def connect_camera(
    lab: Lab,
    clock: ScaledClock,
    name: str,
    recorder: SessionRecorder | None,
    latency: LatencyMonitor | None = None,
) -> StreamCamera:
    """The connected camera `name`, one of `SENSORS`; `recorder` and `latency`, if any, receive every image."""
    settings: CameraSettings = getattr(lab.cameras, name)
    sensor = SENSORS.index(name)
    stale = lab.limits.stale_frame

    def record(image: CameraImage) -> None:
        if recorder is not None:
            recorder.image(sensor, image)
        if latency is not None:
            latency.image(sensor, image)

    return open_camera(
        settings.source,
        name,
        clock,
        timeout=stale,
        latency=settings.latency,
        frozen_after=stale / lab.time_scale,  # images arrive: the computer's jitter is no reason to wait longer
        on_image=record,
    )


def gripper_of(
    lab: Lab,
    clock: ScaledClock,
    recorder: SessionRecorder | None,
    latency: LatencyMonitor | None = None,
    *,
    dry_run: bool,
) -> WsgGripper:
    """The gripper of the lab file, not yet connected. Another driver is created here, with the same two callbacks."""

    def record(name: str, values: Mapping[str, float]) -> None:
        if recorder is not None:
            recorder.gripper_command(clock.now(), name, values)

    def measured(state: GripperState) -> None:
        if recorder is not None:
            recorder.gripper_state(state)
        if latency is not None:
            latency.gripper_state(state)

    return WsgGripper(
        transport_for(lab.gripper.address, clock=clock),
        clock=clock,
        config=WsgConfig(
            stale_after=lab.limits.stale_gripper,
            reply_timeout=lab.limits.gripper_reply,
            move_timeout=lab.limits.gripper_motion,
            home_timeout=max(LIMITS.gripper_home_time, lab.limits.gripper_motion),
            dry_run=dry_run,
        ),
        on_command=record,
        on_measurement=measured,
    )


def controller_monitor(lab: Lab, clock: ScaledClock) -> ControllerMonitor:
    """The monitor of the controller's mode and program, not yet opened."""
    client = WebServicesClient(lab.arm.web_services)
    return ControllerMonitor(client, clock, stale=LIMITS.controller_age * lab.time_scale)


def egm_config(lab: Lab, *, dry_run: bool = False) -> EgmConfig:
    """Configuration of the EGM driver: the bounding box of the lab's workspace, and the lab's speeds and times."""
    space = lab.workspace
    yaw = math.radians(space.yaw_deg)
    corners = itertools.product(
        (-space.x, space.x), (-space.y, space.y), (space.height_min, space.height_max), (-yaw, 0.0, yaw)
    )
    positions = [lab.tool_pose(lab.gripper_at(x, y, turn, height)).position for x, y, height, turn in corners]
    low, high = np.min(positions, axis=0) - _MARGIN, np.max(positions, axis=0) + _MARGIN
    stale = lab.limits.stale_pose
    return EgmConfig(
        workspace_min=(float(low[0]), float(low[1]), float(low[2])),
        workspace_max=(float(high[0]), float(high[1]), float(high[2])),
        port=lab.arm.egm_port,
        host=lab.arm.host,
        robot=lab.arm.robot,
        max_speed=lab.arm.max_speed,
        max_turn_speed=math.radians(lab.arm.max_turn_speed_deg),
        joint_speed=math.radians(lab.arm.joint_speed_deg),
        max_step=space.max_step,
        max_turn=math.radians(space.max_turn_deg),
        stale=stale,
        silence=stale * LIMITS.pose_silence / LIMITS.pose_age,
        max_lifetime=max(LIMITS.longest_target_lifetime, lab.limits.target_lifetime),
        connect_timeout=lab.arm.connect_timeout,
        dry_run=dry_run,
    )


class StopArm:
    """Context manager that stops the arm at the exit and records its last events and the reason."""

    def __init__(self, arm: EgmArm, recorder: SessionRecorder) -> None:
        self._arm = arm
        self._recorder = recorder

    def __enter__(self) -> None:
        """No action at the start of the run."""

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        reason = "the run has ended" if kind is None else f"{kind.__name__}: {error}"
        with contextlib.suppress(GelflowError):
            self._arm.hold()
        self._arm.stop(reason)
        with contextlib.suppress(GelflowError):
            record_events(self._arm, self._recorder)
            self._recorder.event("arm stopped", {"reason": reason})
