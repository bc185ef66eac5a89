"""The insertion runner: grasp a part, then repeat descent, tactile observation and correction until it is inserted.

This module contains the sequence of an attempt, its stop conditions and its records. `motion_executor` executes and
monitors the motions, `tactile_observer` tracks the images, `supervisor` checks the targets.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import PeerRefused, PeerTimeout, SafetyError
from gelflow.geometry import Pose, yaw_quaternion
from gelflow.observation import FlowMap
from gelflow.protocols import Policy
from gelflow.real.runner.cell import Cell
from gelflow.real.runner.motion_executor import MotionExecutor, PartLost
from gelflow.real.runner.supervisor import Supervisor
from gelflow.real.runner.tactile_observer import MarkersUnreadable, TactileObserver, TactileReading
from gelflow.session.records import Decision
from gelflow.task import InsertionTask
from gelflow.time_sync import RUNNER

PlanarPose = tuple[float, float, float]  # of the gripper relative to the taught hole: x, y [m], yaw [rad]
_REST_TIME = 0.1  # from a hold until the arm and the newest images are at rest [s]
_AT_DEPTH = 0.02e-3  # distance from its end at which a descent is complete [m]


class Operator(Protocol):
    """Hands parts over: a person who confirms, or a feeder with a fixed time."""

    def present(self, number: int) -> None:
        """Return when part `number` is between the open fingers."""
        ...

    def take(self, number: int) -> None:
        """Return when the operator is ready to take part `number`, which was not inserted, from the fingers."""
        ...


@dataclass(frozen=True)
class Attempt:
    """One descent and its result."""

    number: int
    planar_pose: PlanarPose  # during the descent
    depth: float  # reached below the start [m]
    shear: float  # mean shear along the finger at the last reading [mm]
    contact: bool  # the shear exceeded contact_shear_mm
    stopped_by_contact: bool  # the shear exceeded stop_shear_mm and stopped the descent
    inserted: bool  # lower face below the success height without contact, then lowered into the hole without contact
    duration: float  # [s]
    observation: FlowMap | None = None  # None when the policy was not evaluated
    correction: NDArray[np.float64] | None = None  # dx, dy [m], dyaw [rad] in the gripper's frame
    reference: TactileReading | None = None
    last: TactileReading | None = None  # the newest reading of the descent


@dataclass(frozen=True)
class Insertion:
    """The attempts on one part, from grasp to release."""

    number: int
    outcome: str  # inserted, not inserted, part lost, or the error
    planar_pose: PlanarPose  # of the last attempt
    duration: float  # [s]
    attempts: tuple[Attempt, ...] = field(default=())

    @property
    def inserted(self) -> bool:
        """Whether the part was inserted."""
        return self.outcome == "inserted"


class InsertionRunner:
    """Inserts parts in a connected cell. The thread of `motion` must be running."""

    def __init__(
        self,
        cell: Cell,
        policy: Policy,
        *,
        task: InsertionTask,
        motion: MotionExecutor,
        operator: Operator,
        on_attempt: Callable[[int, Attempt], None] = lambda number, attempt: None,
    ) -> None:
        lab = cell.lab
        if task.descent > lab.descent.max_depth:
            deep, allowed = 1e3 * task.descent, 1e3 * lab.descent.max_depth
            raise SafetyError(f"the task descends {deep:g} mm, the lab's max_depth allows {allowed:g} mm")
        self._cell, self._policy, self._task = cell, policy, task
        self._lab, self._clock, self._recorder = lab, cell.clock, cell.recorder
        self._motion, self._operator, self._on_attempt = motion, operator, on_attempt
        self.mounts = (lab.cameras.left.mount, lab.cameras.right.mount)

    def insert(self, number: int) -> Insertion:
        """Insert one part; returns the result. Raises errors after which continuing is unsafe (stale data, a fault)."""
        start = self._clock.now()
        attempts: list[Attempt] = []
        planar_pose: PlanarPose = (0.0, 0.0, 0.0)
        self._policy.reset()
        self._recorder.event("insertion", {"number": number})
        try:
            self._load(number)
            outcome = "not inserted"
            for index in range(self._task.attempts):
                attempt = self._attempt_with_retries(number, index, planar_pose)
                attempts.append(attempt)
                self._on_attempt(number, attempt)
                if attempt.inserted:
                    outcome = "inserted"
                    break
                planar_pose = self._next_pose(planar_pose, attempt)
            self._release_part(number, planar_pose, inserted=outcome == "inserted")
        except PartLost:
            outcome = "part lost"
            self._retreat(planar_pose)
        except NotGrasped as error:
            outcome = str(error)
            self._retreat(planar_pose)
        except MarkersUnreadable as error:
            outcome = str(error)
            self._release_part(number, planar_pose, inserted=False)
        result = Insertion(number, outcome, planar_pose, self._clock.now() - start, tuple(attempts))
        tries = len(attempts)
        self._recorder.event("insertion ended", {"number": number, "outcome": outcome, "attempts": tries})
        return result

    def check_plan(self, supervisor: Supervisor) -> list[str]:
        """Check the first targets of a run, each relative to the one before; returns them as text. Nothing moves."""
        lab, task = self._lab, self._task
        state = self._cell.arm.state()
        before = lab.gripper_pose(state.position, state.quaternion)
        turn_speed = math.radians(lab.arm.max_turn_speed_deg)
        taught: PlanarPose = (0.0, 0.0, 0.0)
        checked = []
        for name, height, speed in (
            ("hand-over", lab.part.load_height, lab.arm.max_speed),
            ("start of an attempt", task.start_height, lab.arm.max_speed),
            ("end of an attempt", task.start_height - task.descent, lab.descent.speed),
            ("in the hole", lab.part.insert_to, lab.arm.max_speed),
        ):
            target = self.pose(taught, height)
            supervisor.check(target, before, speed=speed, turn_speed=turn_speed)
            checked.append(f"{name}: lower face at {1e3 * height:.1f} mm, {1e3 * speed:g} mm/s")
            before = target
        return checked

    # Steps of an insertion

    def pose(self, planar_pose: PlanarPose, height: float) -> Pose:
        """Gripper pose in the base frame from a planar pose about the taught hole and the lower face's `height` [m]."""
        x, y, yaw = planar_pose
        above = np.array([x, y, height + self._lab.part.grasp_height])
        return self._lab.hole.pose @ Pose(above, yaw_quaternion(yaw))

    def _load(self, number: int) -> None:
        """Move above the hole, wait for a part and grasp it."""
        part, lab = self._lab.part, self._lab.gripper
        self._motion.expect_part(False)
        self._motion.move(self.pose((0.0, 0.0, 0.0), part.load_height))
        state = self._cell.gripper.state()
        if abs(state.width - lab.open_width) > 1e-3:
            self._cell.gripper.move(width=lab.open_width, speed=lab.speed)
        self._operator.present(number)
        self._motion.wait(0.0)
        try:
            self._cell.gripper.grasp(width=lab.part_width, speed=lab.speed, force=lab.grasp_force)
        except PeerRefused as error:
            raise NotGrasped(str(error)) from error
        self._motion.expect_part(True)

    def _attempt_with_retries(self, number: int, attempt: int, planar_pose: PlanarPose) -> Attempt:
        for _ in range(self._lab.limits.retries):
            try:
                return self._attempt(number, attempt, planar_pose)
            except MarkersUnreadable as error:
                self._recorder.event("attempt repeated", {"attempt": attempt, "reason": str(error)})
        return self._attempt(number, attempt, planar_pose)

    def _attempt(self, number: int, attempt: int, planar_pose: PlanarPose) -> Attempt:
        begun = self._clock.now()
        self._motion.move(self.pose(planar_pose, self._task.start_height))
        observer = TactileObserver(self._cell.cameras, self.mounts, stale=self._lab.limits.stale_frame)
        self._motion.wait(self._lab.descent.settle)
        reference = observer.start(self._clock.now())
        stopped = self._descend(planar_pose, observer, begun)
        frames = observer.chosen(self._task.frame_depths)
        last = observer.readings[-1]
        contact = last.shear > self._lab.descent.contact_shear_mm
        reached = self._task.start_height - last.depth < self._task.success_height
        inserted = reached and not contact and not stopped and self._lower(planar_pose, observer)
        observation, correction = None, None
        if not inserted:
            observation = observer.observe(frames, self._task)
            correction = np.asarray(self._policy.act(observation), dtype=float)
            self._record_decision(number, attempt, planar_pose, observer, frames, observation, correction)
        result = Attempt(
            attempt, planar_pose, last.depth, last.shear, contact, stopped, inserted,
            self._clock.now() - begun, observation, correction, reference, last,
        )  # fmt: skip
        self._recorder.attempt_end(_summary(number, result))
        return result

    def _descend(self, planar_pose: PlanarPose, observer: TactileObserver, begun: float) -> bool:
        """Lower the gripper while the shear is monitored; True when contact stopped it."""
        lab = self._lab
        start = self._height()
        self._motion.go(self.pose(planar_pose, self._task.start_height - self._task.descent), speed=lab.descent.speed)
        arrived = math.inf
        while True:
            self._motion.wait(0.0)
            images = observer.images()
            with self._clock.bounded(RUNNER):
                reading = observer.read(images)
                if reading is not None and reading.shear > lab.descent.stop_shear_mm:
                    self._motion.hold()
            now = self._clock.now()
            if now - begun > lab.limits.attempt_time:
                self._motion.hold()
                raise PeerTimeout(f"an attempt took more than {lab.limits.attempt_time:g} s; does the arm follow?")
            if reading is not None:
                depth = self._add_reading(observer, reading, start)
                if reading.shear > lab.descent.stop_shear_mm:
                    self._recorder.event("stopped by contact", {"shear_mm": reading.shear, "depth": depth})
                    self._read_at_rest(observer, start)
                    return True
                # The descent ends with a pair of images that were both received at its end.
                if min(image.stamp for image in images) > arrived:
                    return False
            if start - self._height() > lab.descent.max_depth:
                self._motion.hold()
                raise SafetyError(f"the gripper is deeper than max_depth ({1e3 * lab.descent.max_depth:g} mm)")
            if arrived == math.inf and self._motion.arrived(within=_AT_DEPTH):
                arrived = now

    def _read_at_rest(self, observer: TactileObserver, start: float) -> None:
        """Add a reading at rest after contact: the cameras are not synchronized, so pads in motion are inconsistent."""
        self._motion.wait(_REST_TIME)
        reading = observer.read(observer.images(self._clock.now()))
        if reading is not None:
            self._add_reading(observer, reading, start)

    def _add_reading(self, observer: TactileObserver, reading: TactileReading, start: float) -> float:
        """Add a reading to those of the attempt; returns its depth below `start` [m]."""
        depth = start - self._motion.height_at(reading.frame.stamp)
        observer.keep(replace(reading, depth=depth))
        return depth

    def _lower(self, planar_pose: PlanarPose, observer: TactileObserver) -> bool:
        """Continue into the hole when the rim caused no contact. False after a contact below the rim."""
        stop = self._lab.descent.stop_shear_mm

        def check_contact() -> None:
            reading = observer.next()
            if reading is not None and reading.shear > stop:
                self._motion.hold()
                self._recorder.event("contact below the rim", {"shear_mm": reading.shear})
                raise _ContactError

        try:
            self._motion.move(self.pose(planar_pose, self._lab.part.insert_to), while_moving=check_contact)
        except _ContactError:
            self._motion.move(self.pose(planar_pose, self._task.start_height))
            return False
        return True

    def _record_decision(
        self,
        number: int,
        attempt: int,
        planar_pose: PlanarPose,
        observer: TactileObserver,
        frames: list[TactileReading],
        observation: FlowMap,
        correction: NDArray[np.float64],
    ) -> None:
        assert observer.reference is not None
        target = self.pose(self._corrected(planar_pose, correction), self._task.start_height)
        decision = Decision.of(
            observation,
            insertion=number,
            attempt=attempt,
            tracked=tuple(map(tuple, observer.tracked)),
            reference=observer.reference.sequences,
            frames=tuple(reading.sequences for reading in frames),
            # Keys of the file format: `action` is the correction, `correction` the corrected pose (see `Decision`).
            action=correction,
            correction=np.array([target.position[0], target.position[1], target.yaw]),
            depths=(observer.reference.depth, *(reading.depth for reading in frames)),
        )
        self._recorder.decision(decision.to_json())

    def _next_pose(self, planar_pose: PlanarPose, attempt: Attempt) -> PlanarPose:
        assert attempt.correction is not None
        self._motion.move(self.pose(planar_pose, self._task.start_height))
        return self._corrected(planar_pose, attempt.correction)

    def _corrected(self, planar_pose: PlanarPose, correction: NDArray[np.float64]) -> PlanarPose:
        """The planar pose after a correction, limited to the task's workspace as in the simulated environment.

        This limit is part of the definition of a correction; the supervisor then checks the resulting target, which it
        refuses and never clamps. Raises SafetyError when the policy's output is not three finite numbers.
        """
        if correction.shape != (3,) or not np.isfinite(correction).all():
            given = correction.tolist()
            raise SafetyError(f"correction refused: the policy gave {given}, expected three finite numbers")
        x, y, yaw = (float(v) for v in self._task.corrected(np.array(planar_pose), correction))
        return x, y, yaw

    def _release_part(self, number: int, planar_pose: PlanarPose, *, inserted: bool) -> None:
        """Release the part: in the hole, or above it to the operator."""
        part, lab = self._lab.part, self._lab.gripper
        if not inserted:
            self._motion.move(self.pose((0.0, 0.0, 0.0), part.load_height))
            self._operator.take(number)
        self._motion.expect_part(False)
        self._motion.wait(0.0)
        self._cell.gripper.release(width=lab.open_width, speed=lab.speed)
        if inserted:
            self._motion.move(self.pose(planar_pose, part.load_height))

    def _retreat(self, planar_pose: PlanarPose) -> None:
        """Without a held part: move up, with the fingers unchanged."""
        self._motion.expect_part(False)
        self._motion.move(self.pose(planar_pose, self._lab.part.load_height))

    def _height(self) -> float:
        return float(self._motion.pose().position[2])


class NotGrasped(PeerRefused):
    """The gripper closed and holds no part: the insertion ends, and the next one may start."""


class _ContactError(Exception):
    """Contact below the rim; raised by a callback to end a move."""


def _summary(number: int, attempt: Attempt) -> dict[str, Any]:
    """The result of an attempt, for the recording."""
    return {
        "insertion": number,
        "attempt": attempt.number,
        "outcome": "inserted" if attempt.inserted else "not inserted",
        "planar_pose": attempt.planar_pose,
        "depth": attempt.depth,
        "shear_mm": attempt.shear,
        "contact": attempt.contact,
        "stopped_by_contact": attempt.stopped_by_contact,
        "duration": attempt.duration,
    }
