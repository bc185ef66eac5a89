"""EGM driver: targets, their checks, holds, and the log of all cycles, against the mock arm over UDP."""

import dataclasses
import itertools
import math
from collections.abc import Iterator

import numpy as np
import pytest
from tests.real.egm.harness import CONFIG, DOWN, MOCK, START, ArmAndMock, free_port, near_start

from gelflow.clock import ScaledClock
from gelflow.errors import SafetyError, UsageError
from gelflow.hardware_mocks.egm.device import MockEgmArm
from gelflow.hardware_mocks.plant import KinematicArm
from gelflow.protocols import Arm
from gelflow.real.egm.driver import EgmArm
from gelflow.real.egm.reference_generator import EgmFlag
from gelflow.real.kinematics import forward


@pytest.fixture
def cell() -> Iterator[ArmAndMock]:
    with ArmAndMock() as cell:
        yield cell


@pytest.mark.parametrize("factor", [1.0, 5.0])
def test_arm_follows_targets_and_logs_every_cycle(factor: float) -> None:
    with ArmAndMock(factor) as cell:
        assert isinstance(cell.arm, Arm)
        assert cell.arm.abortable
        state = cell.arm.state()
        assert state.running
        assert state.motors_on
        assert state.operating_mode == "unknown"
        assert np.allclose(forward(state.joints.tolist())[0], START, atol=1e-6)
        goal = near_start(0.005, -0.003, -0.002)
        cell.go(goal)
        assert np.allclose(cell.plant.arm_pose()[0], goal, atol=2e-5)
        records = cell.arm.drain_log()
        report = cell.mock.report
    # The first reference equals the feedback, and the step of each cycle is bounded.
    assert report.first_error < 1e-12
    assert report.largest_step <= CONFIG.max_speed * CONFIG.cycle * (1 + 1e-9)
    assert report.invalid == 0
    # One record per message; gaps in the message count are lost messages and carry the flag LOST.
    sequences = np.array([r.sequence for r in records])
    gaps = np.diff(sequences) != 1
    assert (np.diff(sequences) >= 1).all()
    assert gaps.tolist() == [EgmFlag.LOST in r.flags for r in records[1:]]
    assert gaps.sum() <= 0.02 * len(records)
    moving = [r for r in records if r.commanded is not None]
    assert moving[-1].commanded == (tuple(goal), tuple(DOWN))
    applied = [r.applied for r in records if r.applied is not None]
    assert applied[0][0] == pytest.approx(START, abs=1e-9)
    assert applied[-1][0] == pytest.approx(goal, abs=1e-6)
    steps = [math.dist(a[0], b[0]) for a, b in itertools.pairwise(applied)]
    assert max(steps) <= CONFIG.max_speed * CONFIG.cycle * (1 + 1e-9)
    # Each message is answered after its arrival, in the order of the messages.
    assert [r.answered >= r.stamp for r in records if r.applied is not None].count(False) == 0
    assert (np.diff([r.stamp for r in records]) >= 0).all()


def test_slow_descent_keeps_its_speed(cell: ArmAndMock) -> None:
    """0.5 mm/s is the descent speed for which the policy was trained."""
    floor = near_start(0, 0, -0.002)
    start = cell.clock.now()
    while cell.clock.now() - start < 1.5:
        cell.arm.target(floor, DOWN, lifetime=0.5, speed=0.5e-3)
        cell.clock.sleep(0.05)
    records = [r for r in cell.arm.drain_log() if r.commanded is not None and r.applied is not None]
    # A busy computer may interrupt a motion: messages are lost, or the target expires.
    interrupted = np.flatnonzero(np.diff([r.sequence for r in records]) != 1) + 1
    longest = max(np.split(np.arange(len(records)), interrupted), key=len)
    half = [records[i] for i in longest[len(longest) // 3 :]]
    heights = np.array([r.applied[0][2] for r in half if r.applied is not None])
    times = np.array([r.controller_time for r in half])
    speed = -np.polyfit(times, heights, 1)[0]
    assert speed == pytest.approx(0.5e-3, rel=0.05)
    measured = np.array([r.measured[0][2] for r in half])
    # The robot lags by 10 to 20 ms, which is 5 to 10 µm at this speed.
    assert np.median(measured - heights) < 20e-6


def test_expired_target_and_hold_freeze_the_reference(cell: ArmAndMock) -> None:
    far = near_start(0.04, 0, 0)
    cell.arm.target(far, DOWN, lifetime=0.15)
    cell.until(lambda: any(e.text == "the target expired" for e in cell.arm.drain_events()), "the target expired")
    cell.at_rest()
    first, _ = cell.arm.reference()
    cell.clock.sleep(0.1)
    assert np.array_equal(cell.arm.reference()[0], first)
    assert START[0] < first[0] < far[0]
    cell.arm.target(far, DOWN, lifetime=1.0)
    cell.clock.sleep(0.1)
    cell.arm.hold()
    cell.until(lambda: any(e.text == "hold was called" for e in cell.arm.drain_events()), "a hold")
    cell.at_rest()
    second, _ = cell.arm.reference()
    cell.clock.sleep(0.1)
    third, _ = cell.arm.reference()
    assert np.array_equal(second, third)
    assert third[0] > first[0]
    assert cell.arm.state().running


@pytest.mark.parametrize(
    ("position", "quaternion", "options", "text"),
    [
        (near_start(0.2, 0, 0), DOWN, {}, "outside the workspace"),
        (START * math.nan, DOWN, {}, "not finite"),
        (START, DOWN * math.nan, {}, "not finite"),
        (START, DOWN * 1.1, {}, "unit quaternion"),
        (near_start(0.049, 0.049, 0), DOWN, {}, "from the reference, at most 0.05 m"),
        (START, np.array([1.0, 0, 0, 0]), {}, "180.000° from the reference"),
        (START, DOWN, {"speed": 0.5}, "speed 0.5 is not"),
        (START, DOWN, {"lifetime": 5.0}, "lifetime 5.0 s is not"),
        (START, DOWN, {"lifetime": math.nan}, "lifetime nan s is not"),
    ],
)
def test_invalid_targets_are_refused_in_the_caller(
    shared: ArmAndMock, position: np.ndarray, quaternion: np.ndarray, options: dict[str, float], text: str
) -> None:
    before = shared.arm.reference()[0]
    with pytest.raises(SafetyError, match=text) as caught:
        shared.arm.target(position, quaternion, **{"lifetime": 0.5, **options})
    assert "\n" not in str(caught.value)
    shared.clock.sleep(0.03)
    assert np.array_equal(shared.arm.reference()[0], before)
    assert not [e for e in shared.arm.drain_events() if e.kind == "refused"], "the target was sent to the process"


@pytest.fixture(scope="module")
def shared() -> Iterator[ArmAndMock]:
    with ArmAndMock() as cell:
        yield cell


def test_invalid_targets_are_also_refused_in_the_egm_process(cell: ArmAndMock) -> None:
    """A caller that bypasses the checks: the process refuses the target and holds."""
    cell.arm.target(near_start(0.04, 0, 0), DOWN, lifetime=1.0)
    cell.arm._send("target", (0.9, 0.0, 0.3), DOWN.tolist(), cell.clock.now() + 1.0, 0.02, 0.1)
    refused: list[str] = []

    def said() -> bool:
        refused.extend(e.text for e in cell.arm.drain_events() if e.kind == "refused")
        return bool(refused)

    cell.until(said, "a refusal")
    assert "x = 0.900000 m is outside the workspace" in refused[0]
    cell.at_rest()
    first, _ = cell.arm.reference()
    cell.clock.sleep(0.05)
    assert np.array_equal(cell.arm.reference()[0], first)


def test_wrong_shapes_raise_usage_error(shared: ArmAndMock) -> None:
    with pytest.raises(UsageError, match=r"expected a position \(3,\)"):
        shared.arm.target(np.zeros(4), DOWN, lifetime=0.1)


def test_lost_messages_are_flagged_and_steps_stay_bounded(cell: ArmAndMock) -> None:
    cell.mock.lose(3, share=0.2)
    cell.go(near_start(0.003, 0, 0))
    records = cell.arm.drain_log()
    lost = sum(EgmFlag.LOST in r.flags for r in records)
    assert lost > 0.05 * len(records)
    assert cell.mock.report.largest_step <= CONFIG.max_speed * CONFIG.cycle * (1 + 1e-9)


def test_dry_run_checks_targets_and_sends_nothing() -> None:
    clock = ScaledClock()
    port = free_port()
    plant = KinematicArm(clock, position=START, quaternion=DOWN)
    mock = MockEgmArm(plant, clock=clock, config=dataclasses.replace(MOCK, port=port))
    mock.start()
    try:
        config = dataclasses.replace(CONFIG, port=port, dry_run=True, connect_timeout=60.0)
        with EgmArm(config, clock=clock) as arm:
            arm.target(near_start(0.01, 0, 0), DOWN, lifetime=0.5)
            with pytest.raises(SafetyError, match="outside the workspace"):
                arm.target(near_start(0.1, 0, 0), DOWN, lifetime=0.5)
            clock.sleep(0.2)
            assert arm.drain_log()[-1].applied is None
        assert mock.report.answers == mock.report.invalid == 0
    finally:
        mock.stop()
