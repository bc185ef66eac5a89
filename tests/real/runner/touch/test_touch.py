"""Touch of the insertion runner over the wire, in worlds unlike training: a pad without the expected change ends it."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.real.runner.harness import BackgroundRun, OraclePolicy, events, free_port, plan_for, wait_for

from gelflow.errors import GelflowError
from gelflow.hardware_mocks.robot import MockRobot, MockRobotConfig
from gelflow.hardware_mocks.simulated_cell.cell import SimulatedCellConfig
from gelflow.hardware_mocks.simulated_cell.world import world_from_tables
from gelflow.mock_lab.lab import lab_for
from gelflow.real.runner.insertion.attempt import Insertion
from gelflow.real.runner.run_plan import run_insertions
from gelflow.task import INSERTION, PUBLISHED_INSERTION, InsertionTask

FACTOR = 6.0
MOST_PUSHED = 1e-3  # of a part in the grip before the arm stops [m]


@contextmanager
def robot_in(world: dict[str, Any], task: InsertionTask = INSERTION) -> Iterator[MockRobot]:
    cell = SimulatedCellConfig(seed=2, world=world_from_tables(world, "test"), task=task)
    with MockRobot(FACTOR, MockRobotConfig(cell=cell, egm_port=free_port(socket.SOCK_DGRAM))) as robot:
        yield robot


@pytest.fixture
def robot() -> Iterator[MockRobot]:
    with robot_in({}) as running:
        yield running


def part(robot: MockRobot) -> dict[str, Any]:
    """Ground truth of the first part."""
    return dict(robot.cell.truth()["parts"][0])


def recorded(folder: Path, name: str) -> list[Any]:
    """Values of the recorded events of this name."""
    return [values for event, values in events(folder / "session.mcap") if event == name]


def insert(robot: MockRobot, folder: Path) -> Insertion:
    return run_insertions(plan_for(robot, folder, OraclePolicy(robot)))[0]


def lowered_to(robot: MockRobot, height: float) -> bool:
    """Whether the held part is below this height above the hole's floor [m]."""
    present = robot.cell.truth()["part"]
    return present is not None and present["phase"] == "gripped" and present["height"] < height


Fault = tuple[str, dict[str, Any]]  # kind and parameters
LOOP: Fault = ("freeze", {"loop": 3})
BLACK: Fault = ("blacken", {})
DESCENT, LOWERING = 24.2e-3, 20e-3  # heights of the part at which the fault begins [m]


@pytest.mark.parametrize(
    ("fault", "height"),
    [
        pytest.param(BLACK, DESCENT, id="black, descent"),
        pytest.param(BLACK, LOWERING, id="black, lowering", marks=pytest.mark.slow),
        pytest.param(LOOP, LOWERING, id="loop, lowering", marks=pytest.mark.slow),
    ],
)
def test_part_is_not_moved_without_readable_images(
    robot: MockRobot, tmp_path: Path, fault: Fault, height: float
) -> None:
    finish = BackgroundRun(lambda: insert(robot, tmp_path))
    wait_for(lambda: lowered_to(robot, height), 280, during=finish)
    for camera in robot.cameras:
        camera.begin_fault(1, *fault)
    before = part(robot)["height"]
    with pytest.raises(GelflowError, match=r"camera (left|right)"):
        finish()
    # 250 ms at the speed of lowering, and the time of this program to begin the fault.
    assert before - part(robot)["height"] < 2e-3
    assert part(robot)["phase"] == "gripped" and part(robot)["largest_push"] < MOST_PUSHED
    assert recorded(tmp_path, "stopped")
    assert {"state": "latched"} in recorded(tmp_path, "state")


def test_image_that_is_live_but_never_changes_is_no_touch(robot: MockRobot, tmp_path: Path) -> None:
    nothing = np.zeros((252, 2))
    robot.cell.marker_displacement = lambda finger: nothing  # type: ignore[method-assign]
    with pytest.raises(GelflowError, match="left camera: the pad shows no weight of the grasped part"):
        insert(robot, tmp_path)
    assert part(robot)["height"] > 30e-3  # it was not lowered


@pytest.mark.slow
def test_insertion_that_the_pads_do_not_show_is_not_believed(robot: MockRobot, tmp_path: Path) -> None:
    finish = BackgroundRun(lambda: insert(robot, tmp_path))
    wait_for(lambda: lowered_to(robot, 24.4e-3), 280, during=finish)
    present = [robot.cell.marker_displacement(finger).copy() for finger in (0, 1)]
    robot.cell.marker_displacement = lambda finger: present[finger]  # type: ignore[method-assign]
    with pytest.raises(GelflowError, match=r"no change at the release .* does not count as inserted"):
        finish()
    assert not recorded(tmp_path, "insertion ended")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "error", "found"),
    [
        pytest.param(PUBLISHED_INSERTION, 3e-3, -3e-3, id="too high, descents of 1.1 mm"),
        pytest.param(INSERTION, -3e-3, 3e-3, id="too low"),
        pytest.param(INSERTION, 3e-3, 0.0, id="too high: met within the descent"),
    ],
)
def test_rim_is_found_by_touch_when_the_hole_is_taught_3_mm_wrong(
    tmp_path: Path, task: InsertionTask, error: float, found: float
) -> None:
    with robot_in({"taught_error": {"z": error}}, task) as robot:
        result = insert(robot, tmp_path)
        truth = part(robot)
    assert result.inserted and truth["inserted"]
    assert result.attempts[-1].height_offset == pytest.approx(found, abs=0.5e-3)
    assert truth["largest_push"] < MOST_PUSHED and truth["largest_slip"] < MOST_PUSHED


def test_hole_taught_outside_the_searched_range_is_refused_with_the_reason(tmp_path: Path) -> None:
    with robot_in({"taught_error": {"z": -5.5e-3}}) as robot:
        result = insert(robot, tmp_path)
        truth = part(robot)
    assert not result.inserted
    assert "above the taught rim" in result.outcome and "teach the height of the hole again" in result.outcome
    assert truth["largest_push"] < MOST_PUSHED


@pytest.mark.slow
def test_contact_is_found_on_gels_five_times_as_stiff(tmp_path: Path) -> None:
    with robot_in({"gels": {"left": 5.0, "right": 5.0}}) as robot:
        result = insert(robot, tmp_path)
        truth = part(robot)
    assert result.inserted == truth["inserted"]
    assert truth["largest_slip"] < MOST_PUSHED and truth["largest_push"] < MOST_PUSHED
    assert recorded(tmp_path, "grasp checked")[0]["contact_mm"] < 0.01


@pytest.mark.slow
def test_pads_with_little_friction_let_no_part_slip_unnoticed(tmp_path: Path) -> None:
    with robot_in({"friction": {"pads": 0.4}}) as robot:
        lab = lab_for(robot)
        result = run_insertions(plan_for(robot, tmp_path, OraclePolicy(robot), lab=lab))[0]
        truth = part(robot)
    assert result.inserted == truth["inserted"]
    assert truth["largest_push"] < MOST_PUSHED


@pytest.mark.slow
def test_part_that_slides_out_of_a_slippery_grip_is_not_called_inserted(robot: MockRobot, tmp_path: Path) -> None:
    """The friction of the pads falls so far that the grip no longer carries the weight of the part."""
    finish = BackgroundRun(lambda: insert(robot, tmp_path))
    wait_for(lambda: lowered_to(robot, 25.2e-3), 280, during=finish)
    robot.cell.change_world(gel_stiffness=1.0, pad_friction=0.05)
    result = finish()
    assert not result.inserted and not part(robot)["inserted"]
    assert part(robot)["largest_push"] < MOST_PUSHED


@pytest.mark.slow
def test_constant_delay_of_a_camera_is_seen_at_the_grasp(robot: MockRobot, tmp_path: Path) -> None:
    robot.cameras[1].begin_fault(1, "delay", {"delay": 0.12})
    warnings: list[str] = []
    for number in range(3):  # where a busy computer delivers images late, a grasp says little about the latency
        folder = tmp_path / str(number)
        folder.mkdir()
        plan = plan_for(robot, folder, OraclePolicy(robot), on_warning=warnings.append)
        result = run_insertions(plan)[0]
        if warnings:
            break
    assert [line.split(":")[0] for line in warnings] == ["right camera"]
    assert "cameras.right.latency" in warnings[0]
    assert recorded(folder, "camera latency") == [{"warning": warnings[0]}]
    assert result.inserted
    assert part(robot)["largest_push"] < 0.3e-3
