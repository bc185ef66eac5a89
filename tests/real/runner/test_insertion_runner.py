"""Insertion runner against the mock robot over pty, TCP, UDP and HTTP: insertions, lost parts, invalid actions."""

import math
import threading
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.real.runner.harness import OraclePolicy, events, mean_displacement, plan_for

import gelflow.real
from gelflow.clock import ScaledClock
from gelflow.errors import SafetyError
from gelflow.geometry import Pose
from gelflow.hardware_mocks.robot import MockRobot
from gelflow.mock_lab.lab import lab_for
from gelflow.observation import FlowMap
from gelflow.real.runner.insertion.attempt import Attempt, Insertion
from gelflow.real.runner.insertion.held_part import HeldPart
from gelflow.real.runner.insertion.insertion_runner import InsertionRunner
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.lab_file import load_lab
from gelflow.real.runner.motion_executor import MotionExecutor, PartLost
from gelflow.real.runner.phases import Phase
from gelflow.real.runner.run_plan import dry_run, run_insertions
from gelflow.real.runner.supervisor import Supervisor
from gelflow.real.runner.touch.grasp_check import nominal_thresholds
from gelflow.real.runner.touch.guarded_motion import Contact
from gelflow.real.runner.touch.observer import TactileReading
from gelflow.session.reader import SessionReader
from gelflow.task import INSERTION, insertion_task


def test_part_is_inserted_and_the_run_is_recorded(robot: MockRobot, tmp_path: Path) -> None:
    measured: list[NDArray[np.float64]] = []  # mean shear of each pad along the finger, at each decision [mm]
    policy = OraclePolicy(robot, answer=lambda: measured.append(mean_displacement(robot)))
    attempts: list[Attempt] = []
    plan = plan_for(robot, tmp_path, policy, on_attempt=lambda number, attempt: attempts.append(attempt))
    results: list[Insertion] = run_insertions(plan)

    assert [result.outcome for result in results] == ["inserted"]
    assert robot.cell.truth()["parts"][0]["inserted"]
    assert len(attempts) == len(results[0].attempts) >= 2 and attempts[-1].inserted
    # Contact with the rim stopped the first descent, and every flow map is normalized.
    first = attempts[0]
    assert first.contact and first.stopped_by_contact and 0.3e-3 < first.depth < 1.15e-3
    # The depth of the last images is the depth at their reception.
    assert attempts[-1].depth == pytest.approx(INSERTION.descent, abs=0.05e-3)
    for observation_map in policy.seen:
        assert observation_map.image.shape == INSERTION.observation_shape and observation_map.unit == "mm"
        assert np.hypot(observation_map.image[0::2], observation_map.image[1::2]).max() == pytest.approx(1, abs=1e-5)
        # The rim pushes both pads towards the fingers' base, with rotated cameras too.
        assert observation_map.image[0].mean() < -0.2 and observation_map.image[2].mean() < -0.2

    # Both pads are observed at rest: the difference to the ground truth is the constant effect of the grip.
    observed = [
        observation_map.divisor * observation_map.image[[0, 2]].mean(axis=(1, 2)) for observation_map in policy.seen
    ]
    assert np.ptp(np.array(observed) - np.array(measured)) < 0.005

    with SessionReader(plan.session) as session:
        counts = session.counts()
        decisions = list(session.decisions())
        lab = session.description()["lab"]
    assert len(decisions) == len(policy.seen) == counts["/decision"]
    assert counts["/attempt"] == len(attempts)
    for topic in ("/left/image", "/right/image", "/arm/pose", "/arm/applied", "/gripper/state", "/gripper/command"):
        assert counts[topic] > 10 or topic == "/gripper/command"
    assert lab["gripper"]["grasp_force"] == plan.lab.gripper.grasp_force
    report = robot.arm.report
    assert report.first_error < 1e-4  # the first reference was the feedback
    # No cycle moved faster than the lab allows; a hold returns the reference to the arm with up to this speed.
    assert report.largest_step <= plan.lab.arm.max_speed * 0.004 * (1 + 1e-9)
    # No cycle turns by more than joint 6 does at 1°/s.
    assert report.largest_turn <= 1.05 * math.radians(1.0) * 0.004
    assert not robot.gripper.fast_stopped  # the disconnect was announced

    # Every motion with a held part has a phase in which the pads are observed.
    phases = phases_of_moves_with_a_part(plan.session)
    assert phases <= {"load", "approach", "descend", "lower", "correct", "retreat"} and "lower" in phases


def phases_of_moves_with_a_part(session: Path) -> set[str]:
    held, phase, phases = False, "", set()
    for name, values in events(session):
        if name == "state":
            phase = values["state"]
        held = {"grasp checked": True, "insertion ended": False}.get(name, held) and phase != "release"
        if name == "move" and held:
            phases.add(phase)
    return phases


@pytest.mark.slow
def test_lost_part_ends_its_insertion_and_the_next_one_starts(robot: MockRobot, tmp_path: Path) -> None:
    lost: list[bool] = []

    def lose() -> None:
        if not lost:
            robot.gripper.lose_part()
            lost.append(True)

    plan = plan_for(robot, tmp_path, OraclePolicy(robot, answer=lose), insertions=2)
    results = run_insertions(plan)
    assert [result.outcome for result in results] == ["part lost", "inserted"]
    recorded = events(plan.session)
    assert "part lost" in dict(recorded)
    # The fingers still press: it is raised slowly enough to observe the pads.
    names = [name for name, _ in recorded]
    retreat = next(values for name, values in recorded[names.index("part lost") :] if name == "move")
    assert retreat["speed"] < plan.lab.arm.max_speed


def test_part_that_moves_in_the_grip_is_raised_and_handed_back(
    robot: MockRobot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The gripper still reports it: the pads are observed until it is released, and the next insertion starts."""
    measured, moved = robot.cell.gripper_state, threading.Event()
    at_grasp: list[float] = []  # the width then: under load, the width of a grip varies by about 0.01 mm

    def with_wider_grip() -> tuple[float, float, float]:
        width, speed, force = measured()
        part = robot.cell.truth()["part"]
        if part is None or part["phase"] != "gripped":
            return width, speed, force
        at_grasp.append(width)
        return at_grasp[0] + (0.7e-3 if moved.is_set() else 0.0), speed, force

    monkeypatch.setattr(robot.cell, "gripper_state", with_wider_grip)
    results = run_insertions(plan_for(robot, tmp_path, OraclePolicy(robot, answer=moved.set)))
    assert [result.outcome for result in results] == [
        "the grip width changed by +0.70 mm since the grasp: the part moved"
    ]
    assert phases_of_moves_with_a_part(tmp_path / "session.mcap") >= {"descend", "retreat"}
    assert robot.cell.truth()["part"] is None or robot.cell.truth()["part"]["phase"] != "gripped"


def test_a_part_that_blocks_the_fingers_is_handed_back(robot: MockRobot, tmp_path: Path) -> None:
    """It is wider than stated, so the grasp is refused; the next insertion begins with open fingers."""
    lab = lab_for(robot)
    lab = replace(lab, gripper=replace(lab.gripper, part_width=lab.gripper.part_width - 6e-3))
    results = run_insertions(plan_for(robot, tmp_path, OraclePolicy(robot), lab=lab, insertions=2))
    assert len(results) == 2 and all("AXIS_BLOCKED" in result.outcome for result in results)
    assert robot.cell.gripper_state()[0] == pytest.approx(lab.gripper.open_width, abs=1e-3)


def test_a_part_that_moves_at_the_hand_over_is_handed_back(
    robot: MockRobot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured, at_grasp = robot.cell.gripper_state, [0.0]

    def with_wider_grip() -> tuple[float, float, float]:
        width, speed, force = measured()
        part = robot.cell.truth()["part"]
        if part is None or part["phase"] != "gripped":
            return width, speed, force
        at_grasp[0] += 0.02e-3  # the operator pulls
        return width + min(at_grasp[0], 0.7e-3), speed, force

    monkeypatch.setattr(robot.cell, "gripper_state", with_wider_grip)
    (result,) = run_insertions(plan_for(robot, tmp_path, OraclePolicy(robot)))
    assert "the part moved" in result.outcome and not result.attempts
    assert robot.cell.truth()["part"] is None or robot.cell.truth()["part"]["phase"] != "gripped"


class Absent:
    """An operator who ends the run when a part is asked for."""

    def present(self, number: int) -> None:
        raise SafetyError("nobody is here")

    def take(self, number: int) -> None:
        raise SafetyError("nobody is here")


def test_a_run_begins_with_a_motion_straight_up(robot: MockRobot, tmp_path: Path) -> None:
    """The fingers may be around a part in the hole when a run ends."""
    start, _ = robot.config.cell.start_tool()
    lab = lab_for(robot)
    x, y, z = lab.hole.position
    lab = replace(lab, hole=replace(lab.hole, position=(x + 3e-3, y, z)), part=replace(lab.part, load_height=0.045))
    with pytest.raises(SafetyError, match="nobody is here"):
        run_insertions(plan_for(robot, tmp_path, OraclePolicy(robot), lab=lab, operator=lambda motion: Absent()))
    moves = [values["position"] for name, values in events(tmp_path / "session.mcap") if name == "move"]
    up, sideways = np.array(moves) - start
    assert up[2] > 1e-3 and np.abs(up[:2]).max() < 1e-4
    assert sideways[0] == pytest.approx(3e-3, abs=1e-4) and sideways[2] == pytest.approx(up[2], abs=1e-4)


EXAMPLE = load_lab(Path(gelflow.real.__path__[0]) / "runner" / "lab_example.toml")


def test_a_hand_over_below_the_start_of_an_attempt_is_refused() -> None:
    """A part would be moved down to it after contact, onto the rim."""
    for height, refused in ((0.020, True), (0.0295, True), (0.0296, False)):
        cell: Any = SimpleNamespace(
            lab=replace(EXAMPLE, part=replace(EXAMPLE.part, load_height=height)), clock=None, recorder=None
        )
        parts: dict[str, Any] = {"policy": None, "motion": None, "operator": None}
        with pytest.raises(SafetyError, match=r"raise part\.load_height") if refused else nullcontext():
            InsertionRunner(cell, task=INSERTION, **parts)


def test_a_task_that_descends_deeper_than_the_lab_allows_is_refused() -> None:
    lab = replace(EXAMPLE, descent=replace(EXAMPLE.descent, max_depth=1e-3))
    cell: Any = SimpleNamespace(lab=lab, clock=None, recorder=None)
    parts: dict[str, Any] = {"policy": None, "motion": None, "operator": None}
    with pytest.raises(SafetyError, match=r"descends by 4\.1 mm, descent\.max_depth of the lab file allows 1 mm"):
        InsertionRunner(cell, task=INSERTION, **parts)


def test_a_hole_so_low_that_its_rim_could_be_the_floor_is_refused() -> None:
    """Contact at a rim that is `height_error` lower than taught would count as the floor."""
    cell: Any = SimpleNamespace(lab=EXAMPLE, clock=None, recorder=None)
    parts: dict[str, Any] = {"policy": None, "motion": None, "operator": None}
    for depth, refused in ((0.008, True), (0.010, True), (0.011, False)):
        task = insertion_task(replace(INSERTION.part, depth=depth))
        with pytest.raises(SafetyError, match="the rim may be as low as") if refused else nullcontext():
            InsertionRunner(cell, task=task, **parts)


def test_a_step_back_to_the_hand_over_is_checked_before_anything_moves() -> None:
    """The arm rises there in one motion after a release, and with a part that is handed back."""
    parts: dict[str, Any] = {"policy": None, "motion": None, "operator": None}
    for height, refused in ((0.040, False), (0.055, True)):
        lab = replace(EXAMPLE, part=replace(EXAMPLE.part, load_height=height))
        cell: Any = SimpleNamespace(lab=lab, clock=None, recorder=None)
        runner = InsertionRunner(cell, task=INSERTION, **parts)
        before = runner.pose((0.0, 0.0, 0.0), height)
        with pytest.raises(SafetyError, match="step 53 mm") if refused else nullcontext():
            assert len(runner.check_plan(Supervisor(lab), before)) == 5


def held_part(lab: Lab, height: float, move: Callable[..., Any]) -> HeldPart:
    """A held part whose lower face is at `height` [m], and whose motions are calls of `move(target)`."""
    part: Any = HeldPart.__new__(HeldPart)
    supervisor = Supervisor(lab)
    for phase in (Phase.LOAD, Phase.APPROACH, Phase.DESCEND):
        supervisor.phases.enter(phase)
    pose = lab.gripper_at(0.0, 0.0, 0.0, height)
    part._motion = SimpleNamespace(supervisor=supervisor, pose=lambda: pose, height_at=lambda _: pose.position[2])
    part._start_z = lab.gripper_at(0.0, 0.0, 0.0, INSERTION.start_height).position[2]
    part._guard = SimpleNamespace(move=lambda target, **_: move(target), rest=lambda: None)
    part._recorder = SimpleNamespace(event=lambda *_: None)
    part._lab, part._task, part.thresholds = lab, INSERTION, nominal_thresholds(lab.descent)
    part._pose = lambda planar_pose, height: lab.gripper_at(0.0, 0.0, 0.0, height)
    part.height_offset, part._deadline, part._baseline = 0.0, np.inf, np.zeros((2, 2))
    return part  # type: ignore[no-any-return]


def test_a_retreat_never_moves_down() -> None:
    targets: list[Pose] = []
    held_part(EXAMPLE, 0.030, targets.append).retreat(0.027)
    assert not targets
    held_part(EXAMPLE, 0.026, targets.append).retreat(0.027)
    assert Supervisor(EXAMPLE).hole_coordinates(targets[0])[3] == pytest.approx(0.027)


def test_contact_at_a_low_rim_is_no_floor_where_the_workspace_ends_above_it() -> None:
    """The rim is 4 mm lower than taught, and the lowest target 0.2 mm below it."""
    lab = replace(
        EXAMPLE,
        part=replace(EXAMPLE.part, insert_to=0.0206),
        workspace=replace(EXAMPLE.workspace, height_min=0.0205),
    )
    frame: Any = SimpleNamespace(stamp=0.0)
    reading = TactileReading(frame, (), 0.0, np.full((2, 2), 0.3))
    part = held_part(lab, 0.0208, lambda target: Contact(reading, 0.3))
    part.height_offset = -0.004
    lowered = part.lower((0.0, 0.0, 0.0))
    assert lowered is not None  # None: on the floor, which counts as inserted
    assert lowered.depth == pytest.approx(INSERTION.start_height - 0.0208)  # the decision records it


def test_a_run_refuses_a_target_outside_the_workspace_as_a_dry_run_does(robot: MockRobot, tmp_path: Path) -> None:
    lab = lab_for(robot)
    lab = replace(lab, arm=replace(lab.arm, max_speed=lab.descent.speed / 2))
    for run in (dry_run, run_insertions):
        with pytest.raises(SafetyError, match=r"target refused: speed 0\.5 mm/s is outside 0 to 0\.25 mm/s"):
            run(plan_for(robot, tmp_path, OraclePolicy(robot), lab=lab))
        (tmp_path / "session.mcap").unlink()
    assert robot.arm.report.largest_step < 1e-9


class InterruptedGripper:
    """A gripper whose state calls `on_read` once: another thread runs between two steps of the caller."""

    def __init__(self) -> None:
        self.grasp = "holding"
        self.on_read: list[threading.Thread] = []

    def state(self) -> Any:
        while self.on_read:
            thread = self.on_read.pop()
            thread.start()
            thread.join(0.5)
        return SimpleNamespace(width=0.05, force=12.0, grasp=self.grasp, fault="")


class FakeArm:
    """An arm at rest; counts its holds."""

    def __init__(self) -> None:
        self.holds = 0

    def state(self) -> Any:
        return SimpleNamespace(position=np.zeros(3), quaternion=np.array([1.0, 0.0, 0.0, 0.0]), stamp=0.0)

    def target(self, *_: Any, **__: Any) -> None: ...

    def hold(self) -> None:
        self.holds += 1


def executor_of(gripper: InterruptedGripper, clock: Any, arm: Any) -> MotionExecutor:
    fakes: Any = {
        "lab": SimpleNamespace(
            arm=SimpleNamespace(max_speed=0.1, max_turn_speed_deg=10.0),
            limits=SimpleNamespace(target_lifetime=0.1),
            gripper_pose=Pose,
            tool_pose=lambda target: target,
        ),
        "supervisor": SimpleNamespace(
            phases=SimpleNamespace(require_motion=lambda: None), check=lambda goal, now, **_: goal
        ),
        "recorder": SimpleNamespace(event=lambda *_: None, check=lambda: None, arm_command=lambda *_, **__: None),
    }
    return MotionExecutor(arm, gripper, [], clock=clock, **fakes)  # type: ignore[arg-type]


def test_a_guarded_motion_holds_when_its_caller_no_longer_observes_the_pads() -> None:
    clock, arm = SimpleNamespace(seconds=0.0), FakeArm()
    clock.now = lambda: clock.seconds
    motion = executor_of(InterruptedGripper(), clock, arm)
    motion.start_motion(Pose(np.array([0.0, 0.0, 0.1]), np.array([1.0, 0.0, 0.0, 0.0])), guarded=True)
    for clock.seconds in (0.2, 0.4, 0.6):
        motion._hold_unobserved(clock.seconds)
        assert motion.report_observation(0.0) and arm.holds == 0
    clock.seconds = 0.9
    motion._hold_unobserved(clock.seconds)
    assert arm.holds == 1 and not motion.report_observation(0.0)
    motion.start_motion(Pose(np.array([0.0, 0.0, 0.1]), np.array([1.0, 0.0, 0.0, 0.0])), guarded=True)
    assert motion.report_observation(0.0)
    clock.seconds = 1.2  # with images that are 0.2 s old
    motion.start_motion(Pose(np.array([0.0, 0.0, 0.1]), np.array([1.0, 0.0, 0.0, 0.0])), guarded=True, age=0.2)
    for clock.seconds, held in ((1.24, False), (1.26, True)):
        motion._hold_unobserved(clock.seconds)
        assert arm.holds == 1 + held
    motion.start_motion(Pose(np.array([0.0, 0.0, 0.1]), np.array([1.0, 0.0, 0.0, 0.0])), guarded=True)
    motion.hold()  # for another reason, such as a lost part: the motion does not continue
    assert motion.report_observation(0.0)


@pytest.mark.parametrize("reported", ["part lost", "idle", "error"])
def test_a_lost_part_is_not_reported_again_once_none_is_expected(reported: str) -> None:
    """The watching thread runs while the runner states that no part is held any more."""
    gripper = InterruptedGripper()
    motion = executor_of(gripper, ScaledClock(), FakeArm())
    motion.expect_part(True)
    gripper.grasp = reported
    motion.watch_part()
    with pytest.raises(PartLost, match=f"the gripper reports {reported}, and holding before"):
        motion.wait(0.0)
    gripper.on_read = [threading.Thread(target=motion.watch_part)]
    motion.expect_part(False)
    motion.wait(0.0)


def test_invalid_action_of_the_policy_causes_no_motion(robot: MockRobot, tmp_path: Path) -> None:
    class InvalidPolicy:
        def reset(self) -> None: ...

        def act(self, observation: FlowMap) -> NDArray[np.float64]:
            return np.array([np.nan, 0, 0])

    with pytest.raises(SafetyError, match="expected three finite numbers"):
        run_insertions(plan_for(robot, tmp_path, InvalidPolicy()))
    assert robot.cell.truth()["part"]["phase"] == "gripped"


@pytest.mark.parametrize("correction", [[np.nan, 0, 0], [0, np.inf, 0], [0, 0]])
def test_corrections_that_are_no_three_finite_numbers_are_refused(correction: list[float]) -> None:
    with pytest.raises(SafetyError, match="expected three finite numbers"):
        InsertionRunner._corrected(SimpleNamespace(), (0.0, 0.0, 0.0), np.array(correction))  # type: ignore[arg-type]


def test_a_gripper_below_the_end_of_its_descent_ends_the_run(
    robot: MockRobot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gelflow.real.runner.insertion.held_part._BEYOND", -3.9e-3)
    with pytest.raises(SafetyError, match=r"deeper than its descent of 4\.1 mm"):
        run_insertions(plan_for(robot, tmp_path, OraclePolicy(robot)))
