"""The simulated world behind the mocks: the hand, the grip, what the gels show, the truth."""

import math
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gelflow.clock import ScaledClock
from gelflow.errors import SimulationError, UsageError
from gelflow.geometry import Pose, yaw_quaternion
from gelflow.hardware_mocks.simulated_cell.cell import SimulatedCell, SimulatedCellConfig
from gelflow.hardware_mocks.simulated_cell.process import SimulatedCellProcess
from gelflow.task import INSERTION
from gelflow.time_sync import TimeSync

PlanarPose = tuple[float, float, float]


def world(seed: int = 0) -> SimulatedCell:
    return SimulatedCell(ScaledClock(), SimulatedCellConfig(seed=seed))


def go(cell: SimulatedCell, place: PlanarPose, height: float, *, steps: int) -> None:
    """Move the gripper evenly to a place about the taught hole, the part's lower face at `height`."""
    config = cell.config
    x, y, yaw = place
    local = Pose(np.array([x, y, height + config.grasp_height]), yaw_quaternion(yaw))
    now = config.hole.inverse() @ (Pose(*cell.arm_pose()) @ config.tool)
    for share in np.linspace(0, 1, steps + 1)[1:]:
        position = now.position + share * (local.position - now.position)
        turn = now.yaw + share * (yaw - now.yaw)
        pose = config.hole @ Pose(position, yaw_quaternion(turn)) @ config.tool.inverse()
        cell.command_arm(pose.position, pose.quaternion)
        cell.advance(1)


def grasped(seed: int = 0) -> SimulatedCell:
    cell = world(seed)
    cell.advance(100)
    cell.command_gripper(width=0.032, speed=0.1, force=12.0)
    cell.advance(120)
    return cell


def in_line(truth: dict[str, Any]) -> PlanarPose:
    """Where the gripper must be about the taught hole to be right over the true one."""
    x, y, yaw = truth["part"]["misalignment"]
    pose = Pose(np.array([x, y, 0.0]), yaw_quaternion(yaw)).inverse()
    return float(pose.position[0]), float(pose.position[1]), pose.yaw


def test_the_hand_holds_out_a_part_and_the_grip_takes_it() -> None:
    cell = world(3)
    assert cell.truth()["part"] is None
    cell.advance(100)
    assert cell.truth()["part"]["phase"] == "presented"
    limits = np.array(INSERTION.misalignment)
    assert (np.abs(cell.truth()["part"]["misalignment"]) <= limits).all()
    cell.command_gripper(width=0.032, speed=0.1, force=12.0)
    cell.advance(120)
    width, speed, force = cell.gripper_state()
    assert cell.truth()["part"]["phase"] == "gripped"
    assert force == pytest.approx(12.0, rel=0.01)
    assert width == pytest.approx(0.035, abs=0.5e-3) and abs(speed) < 1e-4


def test_a_held_part_does_not_creep() -> None:
    cell = grasped()
    before = cell.truth()["part"]["height"]
    cell.advance(2500)  # ten seconds, in which a viscous grip would lose millimetres
    assert abs(cell.truth()["part"]["height"] - before) < 5e-6


def test_the_rim_pushes_the_markers_towards_the_fingers_base_and_the_hole_does_not() -> None:
    cell = grasped()
    go(cell, (0.0, 0.0, 0.0), 0.0255, steps=400)
    rest = np.stack([cell.marker_displacement(finger) for finger in (0, 1)])
    go(cell, (0.0, 0.0, 0.0), 0.0248, steps=350)
    felt = np.stack([cell.marker_displacement(finger) for finger in (0, 1)]) - rest
    assert (felt[..., 0].mean(axis=1) < -0.05).all()  # x runs to the tip, the rim pushes up
    assert not cell.truth()["part"]["inserted"]

    go(cell, (0.0, 0.0, 0.0), 0.0255, steps=200)
    place = in_line(cell.truth())
    go(cell, place, 0.0255, steps=400)
    rest = np.stack([cell.marker_displacement(finger) for finger in (0, 1)])
    go(cell, place, 0.0240, steps=400)
    felt = np.stack([cell.marker_displacement(finger) for finger in (0, 1)]) - rest
    assert np.abs(felt).max() < 0.005
    truth = cell.truth()["part"]
    assert truth["inserted"] and truth["height"] < INSERTION.success_height


def test_what_was_true_when_a_part_was_let_go_stays_on_record() -> None:
    cell = grasped(5)
    place = in_line(cell.truth())
    go(cell, place, 0.0255, steps=400)
    go(cell, place, 0.002, steps=800)
    cell.command_gripper(width=0.06, speed=0.1, force=50.0)
    cell.advance(100)
    assert cell.truth()["part"]["phase"] == "released" and cell.truth()["part"]["inserted"]
    go(cell, (0.0, 0.0, 0.0), cell.config.load_height, steps=600)
    cell.advance(200)
    truth = cell.truth()
    assert [part["seed"] for part in truth["parts"]] == [5, 6]
    assert truth["parts"][0]["inserted"] and truth["part"]["phase"] == "presented"


def test_the_same_seed_gives_the_same_world_bit_for_bit() -> None:
    def run(seed: int) -> tuple[Any, Any]:
        cell = grasped(seed)
        go(cell, (0.0, 0.0, 0.0), 0.0248, steps=400)
        return cell.truth()["part"], cell.marker_displacement(0)

    (first, one), (again, two), (other, _) = run(7), run(7), run(8)
    assert first == again and np.array_equal(one, two)
    assert first["misalignment"] != other["misalignment"]


def test_a_chosen_seed_is_the_next_parts() -> None:
    cell = world()
    cell.next_seed(41)
    cell.advance(100)
    assert cell.truth()["part"]["seed"] == 41


def test_the_hand_waits_until_the_gripper_is_at_rest() -> None:
    cell = world(3)
    start, quaternion = cell.arm_pose()
    for left in np.arange(400, 0, -2) * 1e-6:  # half a millimetre a second: slow, but not at rest
        cell.command_arm(start + np.array([left, 0.0, 0.0]), quaternion)
        cell.advance(1)
    assert cell.truth()["part"] is None
    cell.advance(100)
    go(cell, (0.0, 0.0, 0.0), cell.config.load_height, steps=1)
    cell.command_gripper(width=0.032, speed=0.1, force=12.0)
    cell.advance(120)
    assert cell.truth()["part"]["phase"] == "gripped"
    assert cell.truth()["part"]["slip"] == pytest.approx((0.0, 0.0, 0.0), abs=5e-5)


def test_robot_time_waits_for_a_world_that_falls_behind(tmp_path: Path) -> None:
    TimeSync.create(path := str(tmp_path / "time_sync"))
    clock = ScaledClock(10.0, path)
    cell = SimulatedCell(clock, SimulatedCellConfig(seed=3))
    begun, steps = clock.now(), 0
    ending = threading.Event()

    def dawdle() -> None:
        nonlocal steps
        steps += 1
        time.sleep(2e-3)  # five times too slow
        if steps == 100:
            ending.set()

    cell.run(ending, after_step=dawdle)
    gone = clock.now() - begun
    assert 0.4 <= gone <= 0.44  # and not the 2 s of the wall clock
    assert cell.truth()["waited"] == clock.delay > 0.5


def test_a_step_that_does_not_divide_the_arms_cycle_is_refused() -> None:
    with pytest.raises(UsageError, match="must divide 4 ms"):
        SimulatedCellConfig(step=3e-3)


def wait_for(condition: Callable[[], bool], seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def test_the_world_in_a_process_of_its_own_does_the_same() -> None:
    with SimulatedCellProcess(ScaledClock(4.0), SimulatedCellConfig(seed=3)) as remote:
        assert remote.gripper_state()[0] == pytest.approx(0.06, abs=1e-6)
        wait_for(lambda: (remote.truth()["part"] or {}).get("phase") == "presented")
        assert remote.truth()["part"]["misalignment"] == pytest.approx(
            list(INSERTION.draw_misalignment(np.random.default_rng((3, 0x6E1)), 1)[0])
        )
        remote.command_gripper(width=0.032, speed=0.1, force=12.0)
        wait_for(lambda: remote.truth()["part"]["phase"] == "gripped")
        wait_for(lambda: remote.gripper_state()[2] > 11)
        wait_for(lambda: bool(np.abs(remote.marker_displacement(0)).max() > 0.01))
        position, quaternion = remote.arm_pose()
        remote.command_arm(position + np.array([0, 0, 0.001]), quaternion)
        assert remote.arm_pose()[0][2] == pytest.approx(position[2] + 0.001)


def test_a_world_that_died_is_named() -> None:
    remote = SimulatedCellProcess(ScaledClock(4.0)).start()
    assert remote._helper is not None
    remote.command_arm(np.array([math.nan, 0, 0]), np.array([1.0, 0, 0, 0]))
    wait_for(lambda: remote._helper is not None and not remote._helper.running)
    with pytest.raises(SimulationError, match="the arm cannot move to"):
        remote.truth()
    with pytest.raises(SimulationError, match="failed"):
        remote.stop()
