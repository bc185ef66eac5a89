"""The insertion runner: grasp a part, then repeat descent, tactile observation and correction until it is inserted.

This module contains the sequence of an insertion and its records. `held_part` moves the part, `runner.touch` observes
the pads, `motion_executor` executes and monitors motions, `supervisor` checks targets and phases.
"""

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import PeerRefused, SafetyError
from gelflow.geometry import Pose
from gelflow.observation import FlowMap
from gelflow.protocols import Policy
from gelflow.real.runner.cell import Cell
from gelflow.real.runner.insertion.attempt import PLAN_COMPLETE, Attempt, Insertion, PlanarPose
from gelflow.real.runner.insertion.held_part import HeldPart, HoleNotFound, PartSlipped
from gelflow.real.runner.insertion.planned_motions import PlanPolicy, check_motions
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.motion_executor import MotionExecutor, PartLost
from gelflow.real.runner.phases import Phase
from gelflow.real.runner.supervisor import Supervisor
from gelflow.real.runner.touch.grasp_check import GraspCheck, TouchImplausible, check_grasp
from gelflow.real.runner.touch.observer import MarkersUnreadable, TactileObserver, TactileReading
from gelflow.real.runner.touch.pad_forces import ForceRecord, PadForces
from gelflow.real.wsg.checks import holds_part, may_hold_part
from gelflow.session.records import Decision
from gelflow.task import InsertionTask

_STATE_TIME = 0.2  # after a refused grasp or a lost part, until the state of the gripper shows its result [s]
_LEVEL = 0.5e-3  # a gripper that is lower than the hand-over by less is not raised first [m]
_HAND_OVER_TIME = 3.0  # after the grasp, for the operator to let the part go [s]


class Operator(Protocol):
    """Hands parts over: a person who confirms, or a feeder with a fixed time."""

    def present(self, number: int) -> None:
        """Return when part `number` is between the open fingers."""
        ...

    def take(self, number: int) -> None:
        """Return when the operator is ready to take part `number`, which was not inserted, from the fingers."""
        ...


class InsertionRunner:
    """Inserts parts in a connected cell. The thread of `motion` must be running.

    With a `PlanPolicy` the attempts on each part are the motions of its plan; the part is then handed back. Raises
    UsageError when one of them exceeds the limits of lab or task, and SafetyError when the heights of lab and task
    contradict each other.
    """

    def __init__(
        self,
        cell: Cell,
        policy: Policy,
        *,
        task: InsertionTask,
        motion: MotionExecutor,
        operator: Operator,
        forces: PadForces | None = None,
        on_attempt: Callable[[int, Attempt], None] = lambda number, attempt: None,
    ) -> None:
        lab = cell.lab
        _check_heights(lab, task)
        self._motions = policy.motions if isinstance(policy, PlanPolicy) else ()
        check_motions(self._motions, lab, task)
        self._cell, self._policy, self._task = cell, policy, task
        self._lab, self._clock, self._recorder = lab, cell.clock, cell.recorder
        self._motion, self._operator, self._on_attempt = motion, operator, on_attempt
        self._forces = forces
        self._planar_pose: PlanarPose = (0.0, 0.0, 0.0)
        self.mounts = (lab.cameras.left.mount, lab.cameras.right.mount)

    def insert(self, number: int) -> Insertion:
        """Insert one part; returns the result. Raises errors after which continuing is unsafe (stale data, a fault)."""
        start = self._clock.now()
        attempts: list[Attempt] = []
        self._planar_pose = self._motions[0].planar_pose if self._motions else (0.0, 0.0, 0.0)
        self._policy.reset()
        self._recorder.event("insertion", {"number": number})
        part: HeldPart | None = None
        try:
            part = self._load(number)
            outcome = self._insert_held(number, part, attempts)
        except PartLost as error:
            outcome = self._end_lost(number, part, str(error))
        except NotGrasped as error:
            outcome = str(error)
            self._motion.wait(_STATE_TIME)
            if may_hold_part(self._cell.gripper.state(), grasped=True):  # too wide, for example: it blocked the fingers
                self._release_to_operator(number)
            else:
                self._retreat_empty()
        except PartSlipped as error:  # at the hand-over, before the first attempt
            outcome = str(error)
            self._release_to_operator(number)
        self._motion.supervisor.phases.enter(Phase.IDLE)
        result = Insertion(number, outcome, self._planar_pose, self._clock.now() - start, tuple(attempts))
        tries = len(attempts)
        self._recorder.event("insertion ended", {"number": number, "outcome": outcome, "attempts": tries})
        return result

    def _insert_held(self, number: int, part: HeldPart, attempts: list[Attempt]) -> str:
        """Attempts on a held part until it is inserted, then its release; returns the outcome."""
        outcome = PLAN_COMPLETE if self._motions else "not inserted"
        try:
            for index in range(len(self._motions) or self._task.attempts):
                attempt = self._attempt(number, index, part)
                attempts.append(attempt)
                self._on_attempt(number, attempt)
                if attempt.inserted:
                    self._release_inserted(part)
                    return "inserted"
                self._correct(part, attempt)
        except (HoleNotFound, PartSlipped) as error:
            outcome = str(error)
        self._raise_and_hand_back(number, part)
        return outcome

    def _end_lost(self, number: int, part: HeldPart | None, evidence: str) -> str:
        """End an insertion whose part was lost, or moved in the grip; returns the outcome.

        A part that may still be between the fingers is raised while both pads are observed, then handed back; `part` is
        None at the hand-over. Raises PartLost when it moves again.
        """
        self._motion.expect_part(False)  # the arm holds, and the fingers may still close
        self._motion.wait(_STATE_TIME)
        state = self._cell.gripper.state()
        outcome = evidence if holds_part(state, grasped=True) else "part lost"
        if not may_hold_part(state, grasped=True):
            self._retreat_empty()
            return outcome
        self._motion.expect_part(True)  # as the gripper reports it now
        if part is not None:
            part.retreat(self._lab.part.load_height)
        self._release_to_operator(number)
        return outcome

    def check_plan(self, supervisor: Supervisor, before: Pose) -> list[str]:
        """Check the first targets of a run from the pose `before`; returns them as text. Nothing moves."""
        lab, task = self._lab, self._task
        turn_speed = math.radians(lab.arm.max_turn_speed_deg)
        taught: PlanarPose = (0.0, 0.0, 0.0)
        checked = []
        for name, height, speed in (
            ("hand-over", lab.part.load_height, lab.arm.max_speed),
            ("start of an attempt", task.start_height, lab.arm.max_speed),
            ("end of an attempt", task.start_height - task.descent, lab.descent.speed),
            ("in the hole", lab.part.insert_to, lab.arm.max_speed),
            ("back at the hand-over", lab.part.load_height, lab.arm.max_speed),
        ):
            target = self.pose(taught, height)
            supervisor.check(target, before, speed=speed, turn_speed=turn_speed)
            checked.append(f"{name}: lower face at {1e3 * height:.1f} mm, {1e3 * speed:g} mm/s")
            before = target
        return checked

    # Steps of an insertion

    def pose(self, planar_pose: PlanarPose, height: float) -> Pose:
        """Gripper pose in the base frame from a planar pose about the taught hole and the lower face's `height` [m]."""
        return self._lab.gripper_at(*planar_pose, height)

    def _load(self, number: int) -> HeldPart:
        """Move above the hole, wait for a part, grasp it and check that both pads show its weight."""
        lab = self._lab
        self._motion.supervisor.phases.enter(Phase.LOAD)
        self._motion.expect_part(False)
        self._rise()
        self._motion.move(self.pose((0.0, 0.0, 0.0), lab.part.load_height))
        if abs(self._cell.gripper.state().width - lab.gripper.open_width) > 1e-3:
            self._motion.wait(0.0)
            self._cell.gripper.move(width=lab.gripper.open_width, speed=lab.gripper.speed)
        self._operator.present(number)
        self._motion.wait(0.0)
        observer = self._observer()
        before = observer.at_rest(self._clock.now())
        if self._forces is not None:
            self._forces.set_rest(observer.resting_pads)  # the fingers are open
        latency = self._cell.latency
        self._motion.wait(0.0)  # the fingers do not close after a stop
        with latency.grasp(self._clock):
            try:
                self._cell.gripper.grasp(
                    width=lab.gripper.part_width, speed=lab.gripper.speed, force=lab.gripper.grasp_force
                )
            except PeerRefused as error:
                raise NotGrasped(str(error)) from error
            self._motion.expect_part(True)
            check = self._check_grasp(observer, before)
        for line in latency.warnings():
            self._recorder.event("camera latency", {"warning": line})
        return HeldPart(
            self._motion, observer, check, self.pose,
            lab=lab, clock=self._clock, task=self._task, recorder=self._recorder, excess_latency=latency.excess,
        )  # fmt: skip

    def _observer(self) -> TactileObserver:
        """A new observer; the pads are at rest, and its reference is the first pair of images from now on.

        Raises MarkersUnreadable after `limits.retries` repetitions.
        """
        limits, failures = self._lab.limits, 0
        while True:
            observer = TactileObserver(
                self._cell.cameras,
                self.mounts,
                clock=self._clock,
                stale=limits.stale_frame,
                on_result=None if self._forces is None else self._forces.add,
            )
            try:
                observer.start(self._clock.now())
                return observer
            except MarkersUnreadable as error:
                failures += 1
                if failures > limits.retries:
                    raise
                self._recorder.event("reference repeated", {"reason": str(error)})

    def _check_grasp(self, observer: TactileObserver, before: list[TactileReading]) -> GraspCheck:
        """Compare the pads before and after the grasp, until both show the part's weight or the time is over."""
        self._motion.wait(self._lab.descent.settle)
        end = self._clock.now() + _HAND_OVER_TIME
        while True:
            self._motion.wait(0.0)
            after = observer.at_rest(self._clock.now())
            try:
                check = check_grasp(before, after, self._lab.descent)
            except TouchImplausible:
                # The operator may still hold the part.
                if self._clock.now() > end:
                    raise
                continue
            values = {"weight_mm": check.weight, "noise_mm": check.noise, "contact_mm": check.thresholds.contact}
            self._recorder.event("grasp checked", values)
            return check

    def _attempt(self, number: int, index: int, part: HeldPart) -> Attempt:
        begun = self._clock.now()
        planar_pose = self._planar_pose
        part.set_deadline(begun + self._lab.limits.attempt_time)
        part.go_to_start(planar_pose, Phase.CORRECT if index else Phase.APPROACH)
        self._motion.supervisor.phases.enter(Phase.DESCEND)
        self._motion.wait(self._lab.descent.settle)
        observer = self._observer()
        motion = self._motions[index] if self._motions else None
        depth, stop = (self._task.descent, None) if motion is None else (motion.depth, motion.stop_shear_mm)
        descent = part.descend(planar_pose, observer, depth, stop)
        last, frames = descent.last, observer.readings_at_depths((depth,) if self._motions else self._task.frame_depths)
        contact = last.shear > part.thresholds.contact
        reached = self._task.start_height - last.depth < self._task.success_height
        inserted = False
        if reached and not contact and not descent.stopped and not self._motions:
            below = part.lower(planar_pose)
            inserted = below is None
            if below is not None:
                frames = [below] * len(frames)
        observation, correction = None, None
        if not inserted:
            observation = observer.observe(frames, self._task)
            correction = np.asarray(self._policy.act(observation), dtype=float)
            self._record_decision(number, index, part, observer, frames, observation, correction)
        result = Attempt(
            index, planar_pose, last.depth, last.shear, contact, descent.stopped, inserted,
            self._clock.now() - begun, descent.slipped, part.height_offset,
            observation, correction, observer.reference, last, self._force_of(observer),
        )  # fmt: skip
        self._recorder.attempt_end(result.summary(number))
        return result

    def _force_of(self, observer: TactileObserver) -> tuple[ForceRecord | None, ...]:
        """The forces in the newest images, at the end of an attempt and after its decision."""
        if self._forces is None:
            return ()
        observer.publish_results()
        return self._forces.of(observer.newest_images)

    def _record_decision(
        self,
        number: int,
        attempt: int,
        part: HeldPart,
        observer: TactileObserver,
        frames: list[TactileReading],
        observation: FlowMap,
        correction: NDArray[np.float64],
    ) -> None:
        assert observer.reference is not None
        target = self.pose(self._corrected(self._planar_pose, correction), part.start_height)
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

    def _correct(self, part: HeldPart, attempt: Attempt) -> None:
        """Raise the part and set the corrected pose, to which the next attempt moves."""
        assert attempt.correction is not None
        part.retreat(part.start_height)
        part.set_baseline()
        self._planar_pose = self._corrected(self._planar_pose, attempt.correction)

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

    def _release_inserted(self, part: HeldPart) -> None:
        """Release the part in the hole. Raises TouchImplausible when the pads do not show the release."""
        self._motion.supervisor.phases.enter(Phase.RELEASE)
        part.check_release(self._open)
        self._retreat_empty()

    def _raise_and_hand_back(self, number: int, part: HeldPart) -> None:
        """Raise the part and release it to the operator."""
        part.retreat(self._lab.part.load_height)
        self._release_to_operator(number)

    def _release_to_operator(self, number: int) -> None:
        """Release the part to the operator."""
        phases = self._motion.supervisor.phases
        if phases.phase is Phase.LOAD:  # at the height of the hand-over already
            phases.enter(Phase.RETREAT)
        self._motion.expect_part(False)  # the arm is at rest, and the operator may move the part
        self._operator.take(number)
        phases.enter(Phase.RELEASE)
        self._open()

    def _open(self) -> None:
        self._motion.wait(0.0)  # raises where the gripper has reported a lost part meanwhile
        self._motion.expect_part(False)
        self._motion.wait(0.0)
        self._cell.gripper.release(width=self._lab.gripper.open_width, speed=self._lab.gripper.speed)

    def _retreat_empty(self) -> None:
        """Without a held part: move up, with the fingers unchanged."""
        self._motion.expect_part(False)
        self._motion.supervisor.phases.enter(Phase.RETREAT)
        self._rise()

    def _rise(self) -> None:
        """Without a held part: straight up to the height of the hand-over, unless the gripper is higher.

        The fingers may be around a part in the hole.
        """
        supervisor = self._motion.supervisor
        x, y, yaw, height = supervisor.hole_coordinates(supervisor.within_workspace(self._motion.pose()))
        if height < self._lab.part.load_height - _LEVEL:
            self._motion.move(self.pose((x, y, yaw), self._lab.part.load_height))


def _check_heights(lab: Lab, task: InsertionTask) -> None:
    """Raise SafetyError when the heights of the lab file do not fit the task."""
    if task.descent > lab.descent.max_depth:
        deep, allowed = 1e3 * task.descent, 1e3 * lab.descent.max_depth
        raise SafetyError(
            f"the task descends by {deep:g} mm, descent.max_depth of the lab file allows {allowed:g} mm; raise it, "
            "or train with a smaller [descent] depth in the part file"
        )
    # Of contact that must not count as the floor: at the lowest rim, or of a part that is not inserted.
    lowest = min(task.rim_height - lab.hole.height_error, task.success_height)
    if lowest - lab.part.insert_to <= lab.hole.height_error:
        low, height, error = (1e3 * v for v in (lab.part.insert_to, lowest, lab.hole.height_error))
        raise SafetyError(
            f"contact at the rim and at the floor cannot be distinguished: the rim may be as low as {height:g} mm, "
            f"part.insert_to is {low:g} mm and hole.height_error {error:g} mm; reduce one of these two"
        )
    highest = task.start_height + lab.hole.height_error  # of the start of an attempt, above the highest rim
    if lab.part.load_height <= highest:
        raise SafetyError(
            f"the hand-over is too low: part.load_height is {1e3 * lab.part.load_height:g} mm, and an attempt may "
            f"start at {1e3 * highest:g} mm (hole.height_error included); raise part.load_height"
        )


class NotGrasped(PeerRefused):
    """The gripper closed and holds no part: the insertion ends, and the next one may start."""
