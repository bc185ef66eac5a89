"""Motions of a held part about the hole, each of them guarded, and the search of the rim's height by touch."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.clock import ScaledClock
from gelflow.errors import PeerError, SafetyError
from gelflow.geometry import Pose
from gelflow.real.runner.insertion.attempt import PlanarPose
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.motion_executor import MotionExecutor
from gelflow.real.runner.phases import Phase
from gelflow.real.runner.touch.grasp_check import GraspCheck, check_release
from gelflow.real.runner.touch.guarded_motion import Contact, GuardedMotion, along_finger, downward, in_any_direction
from gelflow.real.runner.touch.observer import MarkersUnreadable, TactileObserver, TactileReading
from gelflow.real.runner.touch.slip import SlipMonitor
from gelflow.session.recorder import SessionRecorder
from gelflow.task import InsertionTask

_SEARCHES = 3  # contacts on the way to one start pose after which the search of the rim ends
_CLEARANCE = 0.5e-3  # of a fast motion above the range in which the rim is searched [m]
_AT_DEPTH = 0.02e-3  # distance from its end at which a descent is complete [m]
_BEYOND = 0.4e-3  # below the end of a descent, the gripper is too deep [m]


class HoleNotFound(PeerError):
    """The rim is not within the expected error of the taught height."""


class PartSlipped(PeerError):
    """The part slipped in the grip by more than is allowed."""


@dataclass(frozen=True)
class Descent:
    """Result of one descent."""

    stopped: bool  # by contact
    slipped: bool
    last: TactileReading


class HeldPart:
    """One held part. The planar pose of the gripper is an argument of every motion.

    Heights are those of the part's lower face above the taught floor of the hole [m]. `height_offset` is the height of
    the rim found by touch above the taught one [m], and part of `start_height`; `excess_latency` is the measured delay
    of the images beyond that in the lab file [s].
    """

    def __init__(
        self,
        motion: MotionExecutor,
        observer: TactileObserver,
        check: GraspCheck,
        pose: Callable[[PlanarPose, float], Pose],
        *,
        lab: Lab,
        clock: ScaledClock,
        task: InsertionTask,
        recorder: SessionRecorder,
        excess_latency: float,
    ) -> None:
        self._motion, self._pose, self._lab, self._clock = motion, pose, lab, clock
        self._task, self._recorder = task, recorder
        self._check, self._excess_latency = check, excess_latency
        self.thresholds = check.thresholds
        self.height_offset = 0.0
        self._slip = 0.0
        self._start_z = 0.0  # of the gripper at the start of the last descent, base frame [m]
        self._deadline = math.inf
        self._grasp_observer = observer  # its reference is before the grasp
        self._observe(observer)
        self.set_baseline()

    def _observe(self, observer: TactileObserver) -> None:
        """Observe the pads relative to the reference of `observer` from now on."""
        self._guard = GuardedMotion(
            self._motion, observer, self._lab, self._clock, self._recorder, excess_latency=self._excess_latency
        )
        self._baseline: NDArray[np.float64] = np.zeros((2, 2))

    def set_deadline(self, deadline: float) -> None:
        """Set the robot time [s] after which approach, descent and lowering raise PeerTimeout; retreat goes on."""
        self._deadline = deadline

    @property
    def start_height(self) -> float:
        """Height of the lower face at the start of an attempt, above the taught floor [m]."""
        return self._task.start_height + self.height_offset

    def set_baseline(self) -> None:
        """Compare the pads with their present state from now on; the arm is at rest, and nothing touches the part.

        Raises PartSlipped when the pads do not show the part's weight.
        """
        self._baseline = self._guard.observer.mean_at_rest(self._clock.now())
        self._check_weight()

    def _check_weight(self) -> None:
        change = self._baseline + self._guard.observer.reference_change(self._grasp_observer)
        if self._lab.descent.weight_check and not self._check.shows_weight(change):
            values = {"weight_mm": self._check.weight, "change_mm": change}
            self._recorder.event("weight not shown", values)
            raise PartSlipped(
                "the pads no longer show the part's weight: it slipped or rests on something; check part.load_height, "
                "gripper.grasp_force and the gels"
            )

    def go_to_start(self, planar_pose: PlanarPose, phase: Phase) -> None:
        """Move to the start of an attempt; contact on the way shows the height of the rim.

        Above the range in which the rim is searched the motion is fast. Raises HoleNotFound when the rim is further
        from its taught height than `hole.height_error`.
        """
        self._motion.supervisor.phases.enter(phase)
        search_height = self._task.rim_height + self._lab.hole.height_error + _CLEARANCE
        if self._lower_face() > search_height:
            self._move_to(planar_pose, search_height, fast=True)
        for _ in range(_SEARCHES):
            if self._move_to(planar_pose, self.start_height):
                return
            self.retreat(self.start_height)
            self.set_baseline()
            self._motion.supervisor.phases.enter(Phase.CORRECT)
        raise HoleNotFound(
            f"contact {_SEARCHES} times on the way to the start of an attempt; check the taught hole and the grasp"
        )

    def _move_to(self, planar_pose: PlanarPose, height: float, *, fast: bool = False) -> bool:
        """Move towards a start pose. After contact returns False, and the height of the contact becomes the rim's."""
        contact = self._guard.move(
            self._pose(planar_pose, height),
            threshold=self.thresholds.fast if fast else self.thresholds.contact,
            measure=in_any_direction,
            baseline=self._baseline,
            speed=self._guard.free_speed if fast else None,
            deadline=self._deadline,
        )
        if contact is not None:
            found = self._lower_face()
            self._event("contact during the approach", contact, height=found)
            self._set_rim(found)
        return contact is None

    def descend(
        self, planar_pose: PlanarPose, observer: TactileObserver, depth_below: float, stop_shear_mm: float | None = None
    ) -> Descent:
        """Descend by `depth_below` [m]; `observer`, whose reference was taken at the start, stores the readings.

        `stop_shear_mm` replaces that of the lab file, and like it is scaled by the weight that the pads show (see
        `check_grasp`). Raises PartSlipped when the pads do not show the part's weight at the start, or the part slips
        by too much.
        """
        self._observe(observer)
        self._check_weight()
        self._start_z = float(self._motion.pose().position[2])
        slip = SlipMonitor(self.thresholds.contact)
        too_deep = min(depth_below + _BEYOND, self._lab.descent.max_depth)
        of_lab = self._lab.descent.stop_shear_mm
        stop = self.thresholds.stop * (1.0 if stop_shear_mm is None else stop_shear_mm / of_lab)

        def on_reading(reading: TactileReading) -> bool:
            depth = self._keep(reading)
            if depth > too_deep:
                raise SafetyError(f"the gripper is deeper than its descent of {1e3 * depth_below:g} mm")
            return slip.add(depth, reading.shear)

        contact = self._guard.move(
            self._pose(planar_pose, self.start_height - depth_below),
            threshold=stop,
            measure=along_finger,
            speed=self._lab.descent.speed,
            within=_AT_DEPTH,
            deadline=self._deadline,
            on_reading=on_reading,
        )
        if contact is not None:
            name = "slip in the grip" if slip.slipped else "stopped by contact"
            self._event(name, contact, depth=observer.readings[-1].depth)
        # A stopped descent, like a complete one, ends with a pair of images at rest: the cameras are not synchronized.
        reading = self._guard.rest() if contact is not None else observer.update_pair(self._clock.now())
        if reading is not None:
            self._keep(reading)
        self._slip += slip.distance
        if self._slip > self._lab.part.max_slip:
            raise PartSlipped(f"the part slipped in the grip by up to {1e3 * self._slip:.1f} mm; hand it over again")
        if not observer.readings:
            raise MarkersUnreadable("the descent ended before a pair of images was readable")
        return Descent(contact is not None, slip.slipped, observer.readings[-1])

    def lower(self, planar_pose: PlanarPose) -> TactileReading | None:
        """Lower the part into the hole. Returns None when the part arrived at the end of the motion or on the floor.

        After contact above the floor returns the reading at rest. The height of a contact near the taught rim becomes
        the height of the rim.
        """
        part, space = self._lab.part, self._lab.workspace
        floor = part.insert_to + self.height_offset
        end = max(floor, space.height_min)  # a rim below the taught one
        self._motion.supervisor.phases.enter(Phase.LOWER)
        contact = self._guard.move(
            self._pose(planar_pose, end),
            threshold=self.thresholds.contact,
            measure=along_finger,
            deadline=self._deadline,
        )
        if contact is None:
            return None
        height = self._lower_face()
        on_floor = height - floor <= self._lab.hole.height_error
        self._event("contact with the floor" if on_floor else "contact below the rim", contact, height=height)
        if on_floor:
            return None
        reading = self._with_depth(self._guard.rest() or contact.reading)
        if self._task.rim_height - height <= self._lab.hole.height_error:
            self._set_rim(height)
        return reading

    def retreat(self, height: float) -> None:
        """Move straight up until the lower face is at `height` [m] above the taught floor; never down.

        Raises PeerError when the part is stuck.
        """
        supervisor = self._motion.supervisor
        supervisor.phases.enter(Phase.RETREAT)
        if self._lower_face() >= height:  # contact from below does not end this motion
            return
        x, y, yaw, _ = supervisor.hole_coordinates(supervisor.within_workspace(self._motion.pose()))
        contact = self._guard.move(
            self._pose((x, y, yaw), height),
            threshold=self.thresholds.stuck,
            measure=downward,
            baseline=self._baseline,  # before the first attempt the shear by the weight, above `stuck` on a soft gel
        )
        if contact is not None:
            self._event("stuck", contact)
            raise PeerError("the part is stuck in the hole: it is pulled down while the arm moves up; free it by hand")

    def check_release(self, open_fingers: Callable[[], None]) -> None:
        """Open the fingers. Raises TouchImplausible when a pad does not show that the part was released."""
        observer = self._guard.observer
        held = observer.at_rest(self._clock.now())
        open_fingers()
        check_release(held, observer.at_rest(self._clock.now()), self._check)

    def _set_rim(self, height: float) -> None:
        offset = height - self._task.rim_height
        limit = self._lab.hole.height_error
        if abs(offset) > limit:
            where = "above" if offset > 0 else "below"
            raise HoleNotFound(
                f"contact {1e3 * abs(offset):.1f} mm {where} the taught rim, at most {1e3 * limit:g} mm is searched; "
                "teach the height of the hole again, and check part.grasp_height"
            )
        self.height_offset = offset

    def _keep(self, reading: TactileReading) -> float:
        """Add a reading to those of the attempt; returns its depth below the start [m]."""
        reading = self._with_depth(reading)
        self._guard.observer.add_reading(reading)
        return reading.depth

    def _with_depth(self, reading: TactileReading) -> TactileReading:
        return replace(reading, depth=float(self._start_z - self._motion.height_at(reading.frame.stamp)))

    def _lower_face(self) -> float:
        """Height of the part's lower face above the taught floor, by the measured pose [m]."""
        return self._motion.supervisor.hole_coordinates(self._motion.pose())[3]

    def _event(self, name: str, contact: Contact, **values: Any) -> None:
        values |= {
            "shear_mm": contact.reading.shear,
            "change_mm": contact.change,
            "image_at": contact.reading.frame.stamp,
        }
        self._recorder.event(name, values)
