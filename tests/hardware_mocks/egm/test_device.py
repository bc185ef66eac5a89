"""Mock arm against an independent EGM client, that of the ABBRobotEGM package."""

import dataclasses
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from ABBRobotEGM import EGM
from tests.common.processes import is_running

from gelflow.clock import ScaledClock
from gelflow.errors import PeerError, UsageError
from gelflow.hardware_mocks.egm.controller import Controller, MockEgmConfig
from gelflow.hardware_mocks.egm.device import MockEgmArm
from gelflow.hardware_mocks.plant import KinematicArm
from gelflow.real.egm.codec import EgmReference, encode_sensor
from gelflow.real.kinematics import HOME, forward

START = np.array([0.40, 0.0, 0.30])
DOWN = np.array([0.0, 0.0, 1.0, 0.0])


class Bench:
    """A mock arm and an independent client."""

    def __init__(self, factor: float = 1.0, **changes: object) -> None:
        self.clock = ScaledClock(factor)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        self.client = EGM(port)
        self.plant = KinematicArm(self.clock, position=START, quaternion=DOWN, lag=0.004)
        config = dataclasses.replace(MockEgmConfig(port=port, comm_timeout=1.0), **changes)  # type: ignore[arg-type]
        self.mock = MockEgmArm(self.plant, clock=self.clock, config=config)

    def __enter__(self) -> "Bench":
        self.mock.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.mock.stop()
        self.client.close()

    def receive(self) -> object:
        ok, state = self.client.receive_from_robot(timeout=10)
        assert ok, "the robot sent nothing"
        return state

    def answer(self, position: np.ndarray, until: Callable[[object], bool], quaternion: np.ndarray = DOWN) -> object:
        """Answer every message with one pose until a state is seen."""
        end = time.monotonic() + 20
        while True:
            state = self.receive()
            if until(state):
                return state
            assert time.monotonic() < end, state
            self.client.send_to_robot_cart(position * 1e3, quaternion)

    def until_report(self, what: Callable[[object], bool]) -> None:
        end = time.monotonic() + 20
        while not what(self.mock.report):
            assert time.monotonic() < end, self.mock.report
            time.sleep(0.01)


def at(state: object) -> np.ndarray:
    pos = state.cartesian.pos  # type: ignore[attr-defined]
    return np.array([pos.x, pos.y, pos.z]) * 1e-3


@pytest.fixture
def bench() -> Iterator[Bench]:
    with Bench(joint_speed=math.radians(30)) as bench:
        yield bench


def test_feedback_is_sent_every_4_ms_before_any_answer(bench: Bench) -> None:
    states = [bench.receive() for _ in range(50)]
    assert np.allclose(at(states[0]), START, atol=1e-9)
    headers = [s.header for s in states]  # type: ignore[attr-defined]
    assert {h.mtype for h in headers} == {2}
    assert (np.diff([h.seqno for h in headers]) == 1).all()
    # The controller's time continues over cycles that a busy computer missed.
    ticks = np.diff([h.tm for h in headers])
    assert np.median(ticks) == 4
    assert (ticks % 4 == 0).all()
    last = states[-1]
    assert last.motors_on  # type: ignore[attr-defined]
    assert last.rapid_running  # type: ignore[attr-defined]
    assert bench.mock.report.state == "waiting"
    assert len(last.joint_angles) == 6  # type: ignore[attr-defined]


def test_arm_follows_with_lag_and_reports_convergence_after_a_second(bench: Bench) -> None:
    goal = START + np.array([0.004, 0.002, -0.003])
    state = bench.answer(goal, lambda s: bool(np.linalg.norm(at(s) - goal) < 1e-6))
    assert bench.mock.report.state == "running"
    assert not state.mci_convergence_met  # type: ignore[attr-defined]
    arrived = state.header.tm  # type: ignore[attr-defined]
    state = bench.answer(goal, lambda s: bool(s.mci_convergence_met))  # type: ignore[attr-defined]
    # The last part of the motion already meets the condition, so the time is a little less than one second.
    assert 500 <= state.header.tm - arrived <= 1100  # type: ignore[attr-defined]


def test_lag_is_that_of_a_robot() -> None:
    """A steady ramp: the robot trails by speed times lag, 10 to 20 ms, and one cycle more of the wire."""
    with Bench(joint_speed=math.radians(30)) as bench:
        bench.answer(START, lambda s: bench.mock.report.state == "running")
        first = bench.receive().header.tm  # type: ignore[attr-defined]
        behind = []
        for _ in range(150):
            state = bench.receive()
            x = START[0] + 0.01 * (state.header.tm - first) * 1e-3  # type: ignore[attr-defined]
            behind.append((x - at(state)[0]) / 0.01)
            bench.client.send_to_robot_cart(np.array([x, START[1], START[2]]) * 1e3, DOWN)
        assert 0.010 < np.median(behind[75:]) < 0.030


def test_default_joint_speed_is_one_degree_a_second() -> None:
    with Bench(factor=4.0, comm_timeout=4.0) as bench:
        turned = np.array([0.0, math.sin(math.radians(10)), math.cos(math.radians(10)), 0.0])
        bench.answer(START, lambda s: bench.mock.report.state == "running")
        first = bench.receive()
        last = bench.answer(START, lambda s: s.header.tm - first.header.tm > 3000, turned)  # type: ignore[attr-defined]
        seconds = (last.header.tm - first.header.tm) * 1e-3  # type: ignore[attr-defined]
        change = np.abs(np.subtract(last.joint_angles, first.joint_angles))  # type: ignore[attr-defined]
        assert change.max() == pytest.approx(seconds * 1.0, rel=0.1)


def test_egm_ends_without_answers_and_restarts_with_a_new_message_count(bench: Bench) -> None:
    goal = START + np.array([0.02, 0, 0])
    bench.answer(goal, lambda s: bool(at(s)[0] > START[0] + 0.001))
    bench.until_report(lambda r: r.state == "ended")  # type: ignore[attr-defined]
    assert bench.mock.report.reason == "no answer for 1.0 s"
    # Until then the arm moves to the last reference, as with a real controller.
    stood = bench.plant.arm_pose()[0]
    assert np.allclose(stood, goal, atol=1e-6)
    bench.until_report(lambda r: r.state == "waiting" and r.sessions == 2)  # type: ignore[attr-defined]
    bench.client.receive_latest(timeout=5)
    assert bench.receive().header.seqno < 2500  # type: ignore[attr-defined]
    bench.answer(START, lambda s: bool(np.linalg.norm(at(s) - START) < 1e-6))


def test_silence_fault_stops_the_feedback_for_its_duration(bench: Bench) -> None:
    bench.receive()
    bench.mock.silence(0.4)
    while bench.client.receive_from_robot(timeout=0)[0]:
        pass
    assert not bench.client.receive_from_robot(timeout=0.15)[0]
    bench.receive()


def test_reference_out_of_range_ends_egm(bench: Bench) -> None:
    bench.answer(START, lambda s: bench.mock.report.state == "running")
    bench.answer(START + np.array([1.0, 0, 0]), lambda s: bench.mock.report.state == "ended")
    assert (
        "a reference is out of range: the pose at (1.400, 0.000, 0.300) m is out of reach" in bench.mock.report.reason
    )


def test_invalid_datagrams_are_counted(bench: Bench) -> None:
    state = bench.receive()
    address = bench.client.egm_addr
    for data in (b"", b"garbage", b"\x00" * 100):
        bench.client.socket.sendto(data, address)
    bench.until_report(lambda r: r.invalid == 3)  # type: ignore[attr-defined]
    assert bench.mock.report.answers == 0
    assert np.allclose(at(state), START)


def test_motor_and_rapid_states_appear_in_the_feedback(bench: Bench) -> None:
    bench.answer(START, lambda s: bench.mock.report.state == "running")
    bench.mock.motors(False)
    bench.answer(START, lambda s: not s.motors_on)  # type: ignore[attr-defined]
    bench.mock.motors(True)
    bench.mock.rapid(False)
    bench.answer(START, lambda s: s.motors_on and not s.rapid_running)  # type: ignore[attr-defined]
    assert bench.mock.report.reason == "motors off", "the first reason ended EGM"


def test_report_is_thread_safe(bench: Bench) -> None:
    counts: list[int] = []

    def ask() -> None:
        counts.extend(bench.mock.report.sent for _ in range(20))

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    assert len(counts) == 80


def test_plant_out_of_reach_is_reported_at_the_start() -> None:
    clock = ScaledClock()
    plant = KinematicArm(clock, position=START + 1.0, quaternion=DOWN)
    with pytest.raises(UsageError, match=r"the mock arm cannot start at the pose of its plant: .*out of reach"):
        MockEgmArm(plant, clock=clock).start()


def test_calls_on_a_stopped_mock_raise_usage_error(bench: Bench) -> None:
    with pytest.raises(UsageError, match="already running"):
        bench.mock.start()
    bench.mock.stop()
    with pytest.raises(UsageError, match=r"not running; call start\(\) first"):
        bench.mock.motors(False)
    bench.mock.start()
    bench.receive()


_ROBOT_PROCESS = """
import sys, time
import numpy as np
from gelflow.clock import ScaledClock
from gelflow.hardware_mocks.egm.controller import MockEgmConfig
from gelflow.hardware_mocks.egm.device import MockEgmArm
from gelflow.hardware_mocks.plant import KinematicArm
from gelflow.time_sync import TimeSync

TimeSync.create(sys.argv[1])
clock = ScaledClock(1.0, sys.argv[1])
plant = KinematicArm(clock, position=np.array([0.40, 0.0, 0.30]), quaternion=np.array([0.0, 0.0, 1.0, 0.0]), lag=0.004)
arm = MockEgmArm(plant, clock=clock, config=MockEgmConfig(port=int(sys.argv[2])))
arm.start()
print(arm.pid, flush=True)
time.sleep(60)
"""


def test_the_controller_ends_when_the_mock_robot_is_killed_before_it_answers(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        words = [sys.executable, "-c", _ROBOT_PROCESS, str(tmp_path / "time_sync"), str(receiver.getsockname()[1])]
        with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as robot:
            assert robot.stdout is not None
            controller = int(robot.stdout.readline())
            # The controller gets no answer from a stopped process, and robot time stands still.
            robot.send_signal(signal.SIGSTOP)
            time.sleep(0.3)
            robot.kill()
    end = time.monotonic() + 60.0
    while is_running(controller):
        assert time.monotonic() < end, "the controller runs without its parent"
        time.sleep(0.05)


def test_killed_controller_is_detected(bench: Bench) -> None:
    assert bench.mock.pid is not None
    os.kill(bench.mock.pid, signal.SIGKILL)
    with pytest.raises(PeerError, match="the mock controller's process has ended"):
        for _ in range(1000):
            bench.mock.motors(True)
            time.sleep(0.01)
    with pytest.raises(PeerError, match=r"has ended \(exit status -9\)"):
        bench.mock.stop()
    bench.mock.stop()


@pytest.mark.parametrize("changes", [{"lag": 0.0}, {"port": 0}, {"comm_timeout": -1.0}])
def test_invalid_settings_are_refused(changes: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        MockEgmConfig(**changes)  # type: ignore[arg-type]


def test_the_largest_step_is_that_of_one_cycle() -> None:
    position, quaternion = forward(HOME)
    controller = Controller(MockEgmConfig(), ScaledClock(), (position, quaternion))

    def follow(sequence: int, rise: float) -> float:
        moved = (position[0], position[1], position[2] + rise)
        controller.receive(encode_sensor(EgmReference(sequence, 0.0, moved, quaternion)))
        return controller.report.largest_step

    assert follow(0, 0.0) == 0.0
    controller.cycle(1)
    assert follow(1, 1e-5) == pytest.approx(1e-5)
    controller.cycle(4)  # this computer was busy: the sender has moved on for four cycles
    assert follow(2, 5e-5) == pytest.approx(1e-5)
    controller.cycle(1)
    assert follow(3, 9e-5) == pytest.approx(4e-5)
