"""Runs of several insertions: open the cell, preflight, insert, record, close; and dry runs."""

import contextlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import GelflowError, UsageError
from gelflow.observation import FlowMap, flow_map
from gelflow.protocols import Policy
from gelflow.real.runner.cell import Cell, open_cell
from gelflow.real.runner.insertion.attempt import Attempt, Insertion
from gelflow.real.runner.insertion.insertion_runner import InsertionRunner, Operator
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.motion_executor import MotionExecutor
from gelflow.real.runner.phases import Phase
from gelflow.real.runner.preflight import PreflightItem, run_preflight
from gelflow.real.runner.supervisor import Supervisor
from gelflow.real.runner.touch.observer import TactileObserver
from gelflow.real.runner.touch.pad_forces import pad_forces
from gelflow.session.recorder import SessionRecorder
from gelflow.session.records import describe_session
from gelflow.task import InsertionTask


@dataclass(frozen=True)
class RunPlan:
    """The parameters of a run and its callbacks."""

    lab: Lab
    policy: Policy
    task: InsertionTask
    session: Path  # the recording, a new file
    checkpoint: Path | None = None  # of the policy, for the recording
    insertions: int = 1
    operator: Callable[[MotionExecutor], Operator] | None = None  # None: wait for the lab file's part.load_wait
    on_preflight: Callable[[list[PreflightItem]], None] = lambda items: None
    on_attempt: Callable[[int, Attempt], None] = lambda number, attempt: None
    on_insertion: Callable[[Insertion], None] = lambda insertion: None
    on_warning: Callable[[str], None] = lambda line: None  # at the end of the run
    before_insertion: Callable[[int], None] = lambda number: None
    on_motion: Callable[[MotionExecutor], None] = lambda motion: None  # before anything moves


class WaitingOperator:
    """An operator or feeder that presents each part within a fixed time."""

    def __init__(self, motion: MotionExecutor, seconds: float) -> None:
        self._motion, self._seconds = motion, seconds

    def present(self, number: int) -> None:
        self._motion.wait(self._seconds)

    def take(self, number: int) -> None:
        self._motion.wait(self._seconds)


@dataclass(frozen=True)
class DryRun:
    """Result of a dry run, in which nothing moved."""

    items: list[PreflightItem]
    targets: list[str]  # the first targets, after the supervisor's check
    observation: FlowMap  # from two pairs of images at rest, without contact
    correction: NDArray[np.float64]  # of the policy for this observation: dx, dy [m], dyaw [rad] in the gripper frame


def run_insertions(plan: RunPlan) -> list[Insertion]:
    """Run and record the insertions of a plan. Raises the first error after which continuing is unsafe.

    Raises UsageError when a person presents the parts (`part.presentation` is "prompt") and the plan has no operator:
    the fingers would close without a question.
    """
    if plan.operator is None and plan.lab.part.presentation == "prompt":
        raise UsageError(
            'part.presentation of the lab is "prompt", and the run has no operator to ask: give RunPlan an operator, '
            'or set presentation = "wait" where a part is always present after load_wait'
        )
    results = []
    with (
        _recording(plan, dry_run=False) as recorder,
        pad_forces(plan.lab, recorder) as forces,
        open_cell(plan.lab, recorder) as cell,
    ):
        supervisor, motion = create_motion(cell)
        plan.on_motion(motion)
        supervisor.phases.enter(Phase.PREFLIGHT)
        plan.on_preflight(run_preflight(cell, supervisor))
        operator = WaitingOperator(motion, plan.lab.part.load_wait) if plan.operator is None else plan.operator(motion)
        with motion:
            runner = InsertionRunner(
                cell,
                plan.policy,
                task=plan.task,
                motion=motion,
                operator=operator,
                forces=forces,
                on_attempt=plan.on_attempt,
            )
            runner.check_plan(supervisor, motion.pose())
            for number in range(plan.insertions):
                plan.before_insertion(number)
                results.append(runner.insert(number))
                plan.on_insertion(results[-1])
        for line in cell.latency.warnings():
            plan.on_warning(line)
        if forces is not None and forces.problem:
            plan.on_warning(forces.problem)
    return results


def dry_run(plan: RunPlan) -> DryRun:
    """Connect, preflight, check the first targets, read the pads and evaluate the policy, without motion."""
    with _recording(plan, dry_run=True) as recorder, open_cell(plan.lab, recorder, dry_run=True) as cell:
        supervisor, motion = create_motion(cell)
        before = motion.pose()  # now: a controller whose messages are not answered soon ends EGM
        items = run_preflight(cell, supervisor)
        runner = InsertionRunner(
            cell, plan.policy, task=plan.task, motion=motion, operator=WaitingOperator(motion, plan.lab.part.load_wait)
        )
        observer = TactileObserver(cell.cameras, runner.mounts, clock=cell.clock, stale=plan.lab.limits.stale_frame)
        observer.start(0.0)
        reading = observer.at_rest(cell.clock.now())[-1]
        assert observer.reference is not None
        observation = flow_map([reading.frame], observer.reference.frame, grid=plan.task.grid)
        plan.policy.reset()
        correction = np.asarray(plan.policy.act(observation), dtype=float)
        return DryRun(items, runner.check_plan(supervisor, before), observation, correction)


def create_motion(cell: Cell) -> tuple[Supervisor, MotionExecutor]:
    """The supervisor and the motion executor of a cell; `with` starts the executor's thread."""

    def record_phase(phase: Phase) -> None:
        # A recorder that has failed must not keep the supervisor from latching; its own check ends the run.
        with contextlib.suppress(GelflowError):
            cell.recorder.event("state", {"state": str(phase)})

    supervisor = Supervisor(cell.lab, on_phase=record_phase)
    motion = MotionExecutor(
        cell.arm,
        cell.gripper,
        cell.cameras,
        lab=cell.lab,
        clock=cell.clock,
        supervisor=supervisor,
        recorder=cell.recorder,
        controller=cell.controller,
    )
    return supervisor, motion


@contextmanager
def _recording(plan: RunPlan, *, dry_run: bool) -> Iterator[SessionRecorder]:
    mounts = [plan.lab.cameras.left.mount, plan.lab.cameras.right.mount]
    description = describe_session(
        task=plan.task,
        trackers=[mount.tracker_config() for mount in mounts],
        mounts=mounts,
        gels=[plan.lab.cameras.left.elastic_gel, plan.lab.cameras.right.elastic_gel],
        checkpoint=plan.checkpoint,
        lab=plan.lab,
        clock_factor=plan.lab.clock_factor,
        dry_run=dry_run,
    )
    max_delay = plan.lab.limits.recording_delay
    with SessionRecorder(plan.session, plan.lab.clock, max_delay=max_delay).open() as recorder:
        recorder.metadata(description)
        yield recorder
