"""Simulated cell: simulated operator, gripper drive, marker displacements, ground truth."""

import math
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.hardware_mocks.simulated_cell.harness import aligned_pose, go, grasped

from gelflow.clock import ScaledClock
from gelflow.errors import SimulationError, UsageError
from gelflow.hardware_mocks.simulated_cell import process
from gelflow.hardware_mocks.simulated_cell.cell import SimulatedCell, SimulatedCellConfig
from gelflow.hardware_mocks.simulated_cell.process import SimulatedCellProcess
from gelflow.hardware_mocks.simulated_cell.world import Gels, World
from gelflow.task import INSERTION
from gelflow.time_sync import TimeSync


def simulated_cell(seed: int = 0) -> SimulatedCell:
    return SimulatedCell(ScaledClock(), SimulatedCellConfig(seed=seed))


def test_operator_presents_a_part_and_the_gripper_grasps_it() -> None:
    cell = simulated_cell(3)
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


def test_held_part_does_not_creep() -> None:
    cell = grasped(SimulatedCellConfig())
    before = cell.truth()["part"]["height"]
    cell.advance(2500)  # ten seconds, in which a grip with viscous friction loses millimetres
    assert abs(cell.truth()["part"]["height"] - before) < 5e-6


def test_rim_displaces_the_markers_towards_the_fingers_base_and_the_hole_does_not() -> None:
    cell = grasped(SimulatedCellConfig())
    go(cell, (0.0, 0.0, 0.0), 0.0255, steps=400)
    rest = np.stack([cell.marker_displacement(finger) for finger in (0, 1)])
    go(cell, (0.0, 0.0, 0.0), 0.0248, steps=350)
    change = np.stack([cell.marker_displacement(finger) for finger in (0, 1)]) - rest
    assert (change[..., 0].mean(axis=1) < -0.05).all()  # x points to the fingertip, the rim pushes up
    assert not cell.truth()["part"]["inserted"]

    go(cell, (0.0, 0.0, 0.0), 0.0255, steps=200)
    pose = aligned_pose(cell.truth()["part"])
    go(cell, pose, 0.0255, steps=400)
    rest = np.stack([cell.marker_displacement(finger) for finger in (0, 1)])
    go(cell, pose, 0.0240, steps=400)
    change = np.stack([cell.marker_displacement(finger) for finger in (0, 1)]) - rest
    assert np.abs(change).max() < 0.005
    truth = cell.truth()["part"]
    assert truth["inserted"] and truth["height"] < INSERTION.success_height


def test_ground_truth_at_the_release_is_kept() -> None:
    cell = grasped(SimulatedCellConfig(seed=5))
    pose = aligned_pose(cell.truth()["part"])
    go(cell, pose, 0.0255, steps=400)
    go(cell, pose, 0.002, steps=800)
    cell.command_gripper(width=0.06, speed=0.1, force=50.0)
    cell.advance(100)
    assert cell.truth()["part"]["phase"] == "released" and cell.truth()["part"]["inserted"]
    go(cell, (0.0, 0.0, 0.0), cell.config.load_height, steps=600)
    cell.advance(200)
    truth = cell.truth()
    assert [part["seed"] for part in truth["parts"]] == [5, 6]
    assert truth["parts"][0]["inserted"] and truth["part"]["phase"] == "presented"


def test_same_seed_gives_bit_identical_results() -> None:
    def run(seed: int) -> tuple[Any, Any]:
        cell = grasped(SimulatedCellConfig(seed=seed))
        go(cell, (0.0, 0.0, 0.0), 0.0248, steps=400)
        return cell.truth()["part"], cell.marker_displacement(0)

    (first, one), (again, two), (other, _) = run(7), run(7), run(8)
    assert first == again and np.array_equal(one, two)
    assert first["misalignment"] != other["misalignment"]


def test_next_seed_selects_the_next_part() -> None:
    cell = simulated_cell()
    cell.next_seed(41)
    cell.advance(100)
    assert cell.truth()["part"]["seed"] == 41


def test_operator_waits_until_the_gripper_is_at_rest() -> None:
    cell = simulated_cell(3)
    start, quaternion = cell.arm_pose()
    for left in np.arange(400, 0, -2) * 1e-6:  # 0.5 mm/s: slow, but not at rest
        cell.command_arm(start + np.array([left, 0.0, 0.0]), quaternion)
        cell.advance(1)
    assert cell.truth()["part"] is None
    cell.advance(100)
    go(cell, (0.0, 0.0, 0.0), cell.config.load_height, steps=1)
    cell.command_gripper(width=0.032, speed=0.1, force=12.0)
    cell.advance(120)
    assert cell.truth()["part"]["phase"] == "gripped"
    assert cell.truth()["part"]["slip"] == pytest.approx((0.0, 0.0, 0.0), abs=5e-5)


def test_robot_time_waits_for_a_slow_simulation(tmp_path: Path) -> None:
    TimeSync.create(path := str(tmp_path / "time_sync"))
    clock = ScaledClock(10.0, path)
    cell = SimulatedCell(clock, SimulatedCellConfig(seed=3))
    begun, steps = clock.now(), 0
    ending = threading.Event()

    def delay() -> None:
        nonlocal steps
        steps += 1
        time.sleep(2e-3)  # five times slower than robot time
        if steps == 100:
            ending.set()

    cell.run(ending, after_step=delay)
    elapsed = clock.now() - begun
    assert 0.4 <= elapsed <= 0.44  # not the 2 s of the wall clock
    assert cell.truth()["waited"] == clock.delay > 0.5


def test_step_must_divide_the_cycle_of_the_arm() -> None:
    with pytest.raises(UsageError, match="must divide 4 ms"):
        SimulatedCellConfig(step=3e-3)


def wait_for(condition: Callable[[], bool], seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the condition was not met in time"
        time.sleep(0.02)


def test_simulated_cell_in_a_helper_process() -> None:
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


def test_failed_simulation_is_reported() -> None:
    remote = SimulatedCellProcess(ScaledClock(4.0)).start()
    assert remote._helper is not None
    remote.command_arm(np.array([math.nan, 0, 0]), np.array([1.0, 0, 0, 0]))
    wait_for(lambda: remote._helper is not None and not remote._helper.running)
    with pytest.raises(SimulationError, match="the arm cannot move to"):
        remote.truth()
    with pytest.raises(SimulationError, match="failed"):
        remote.stop()


def test_a_late_answer_is_not_taken_for_the_next_one(monkeypatch: pytest.MonkeyPatch) -> None:
    with SimulatedCellProcess(ScaledClock(4.0)) as remote:
        assert remote._helper is not None
        with monkeypatch.context() as patience:
            patience.setattr(process, "_ANSWER_LIMIT", 0.05)
            os.kill(remote._helper.pid, signal.SIGSTOP)
            os.waitpid(remote._helper.pid, os.WUNTRACED)  # all its threads have stopped
            with pytest.raises(SimulationError, match="did not answer"):
                remote.next_seed(3)
            os.kill(remote._helper.pid, signal.SIGCONT)
        assert remote.truth()["parts"] == remote.truth()["parts"]


def test_a_world_beyond_its_limits_is_refused_and_the_cell_goes_on() -> None:
    config = SimulatedCellConfig(world=World(gels=Gels(left=60.0)))
    with SimulatedCellProcess(ScaledClock(4.0), config) as remote:
        with pytest.raises(UsageError, match=r"left must be within 0\.001 to 2500, got 3000"):
            remote.change_world(gel_stiffness=50.0, pad_friction=1.0)
        remote.change_world(gel_stiffness=5.0, pad_friction=1.0)


def test_a_cell_that_fails_during_an_answer_is_reported() -> None:
    remote = SimulatedCellProcess(ScaledClock(4.0)).start()
    with pytest.raises(SimulationError, match="has ended"):
        remote._ask({"ask": "no question"})
    wait_for(lambda: remote._helper is not None and not remote._helper.running)
    with pytest.raises(SimulationError, match="failed: exit status 1: KeyError: 'no question'"):
        remote.stop()
