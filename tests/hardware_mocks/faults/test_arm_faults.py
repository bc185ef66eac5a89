"""Faults of the mock arm, as an independent EGM client sees them."""

import math
import socket
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from ABBRobotEGM._egm_protobuf import egm_pb2
from google.protobuf.message import DecodeError

from gelflow.clock import ScaledClock
from gelflow.hardware_mocks.egm.controller import MockEgmConfig
from gelflow.hardware_mocks.egm.device import MockEgmArm
from gelflow.hardware_mocks.faults.injector import Devices
from gelflow.hardware_mocks.faults.plan import Fault
from gelflow.hardware_mocks.plant import KinematicArm

START = np.array([0.40, 0.0, 0.30])
DOWN = np.array([0.0, 0.0, 1.0, 0.0])


class Bench:
    """A mock arm and a UDP client that answers every message with one position."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(5.0)
        clock = ScaledClock(1.0)
        plant = KinematicArm(clock, position=START, quaternion=DOWN, lag=0.004)
        config = MockEgmConfig(port=self.socket.getsockname()[1], comm_timeout=1.0, joint_speed=math.radians(30))
        self.arm = MockEgmArm(plant, clock=clock, config=config)
        self.sent = 0

    def receive(self, *, goal: float | None = None) -> tuple[float, bytes]:
        """Arrival time and bytes of the next datagram; answers with a height of `goal` [m] above the start."""
        data, sender = self.socket.recvfrom(4096)
        if goal is not None:
            message = egm_pb2.EgmSensor()
            message.header.seqno, message.header.mtype = self.sent, 3
            x, y, z = START[0] * 1e3, START[1] * 1e3, (START[2] + goal) * 1e3
            message.planned.cartesian.pos.x, message.planned.cartesian.pos.y, message.planned.cartesian.pos.z = x, y, z
            u = message.planned.cartesian.orient
            u.u0, u.u1, u.u2, u.u3 = DOWN
            self.socket.sendto(message.SerializeToString(), sender)
            self.sent += 1
        return time.monotonic(), data

    def many(self, count: int, *, goal: float | None = None) -> list[bytes]:
        return [self.receive(goal=goal)[1] for _ in range(count)]

    def begin(self, kind: str, direction: str = "both", **values: Any) -> None:
        self.arm.begin_fault(1, kind, direction, values)
        self.socket.setblocking(False)
        try:  # messages from before the fault
            while self.socket.recv(4096):
                pass
        except BlockingIOError:
            self.socket.settimeout(5.0)


def parsed(data: bytes) -> Any:
    message = egm_pb2.EgmRobot()
    message.ParseFromString(data)
    return message


def sequence(messages: list[bytes]) -> list[int]:
    return [parsed(data).header.seqno for data in messages]


def height(data: bytes) -> float:
    return float(parsed(data).feedBack.cartesian.pos.z) * 1e-3 - float(START[2])


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    bench.arm.start()
    bench.many(3)
    yield bench
    bench.arm.stop()
    bench.socket.close()


def test_dropped_feedback_leaves_gaps_in_the_count(bench: Bench) -> None:
    bench.begin("drop", "out", share=0.5, seed=1)
    steps = np.diff(sequence(bench.many(40)))
    assert steps.max() > 1 and steps.min() >= 1


def test_dropped_references_do_not_arrive(bench: Bench) -> None:
    bench.many(20, goal=0.0)
    bench.begin("drop", "in", share=1.0, seed=1)
    before = bench.arm.report.answers
    bench.many(20, goal=0.0)
    assert bench.arm.report.answers == before
    bench.arm.end_fault(1)
    bench.many(20, goal=0.0)
    assert bench.arm.report.answers > before


def test_duplicated_feedback_repeats_a_count(bench: Bench) -> None:
    bench.begin("duplicate", "out", share=1.0, seed=1)
    counts = sequence(bench.many(41)[1:])
    assert len(set(counts)) <= 22


def test_reordered_feedback_counts_backwards(bench: Bench) -> None:
    bench.begin("reorder", "out", share=0.5, seed=1)
    assert np.diff(sequence(bench.many(60))).min() < 0


def test_delayed_feedback_is_old(bench: Bench) -> None:
    bench.many(20, goal=0.0)
    bench.begin("delay", "out", share=1.0, delay=0.5, seed=1)
    first = bench.receive(goal=0.0)
    end = time.monotonic() + 0.2
    while time.monotonic() < end:  # the answers go on: EGM stays in control
        first = bench.receive(goal=0.0)
    assert bench.arm.report.sent - parsed(first[1]).header.seqno > 60


def test_corrupt_feedback_differs_from_a_valid_message(bench: Bench) -> None:
    bench.begin("corrupt", "out", share=1.0, count=30, seed=1)
    rows = bench.many(20)
    unreadable = 0
    for data in rows:
        try:
            unreadable += parsed(data).header.mtype != 2 or abs(height(data)) > 1e-9
        except DecodeError:
            unreadable += 1
    assert unreadable > 15


def test_corrupt_references_are_counted_as_invalid(bench: Bench) -> None:
    bench.many(20, goal=0.0)
    bench.begin("corrupt", "in", share=1.0, count=30, seed=1)
    bench.many(30, goal=0.0)
    assert bench.arm.report.invalid > 0


def test_split_feedback_arrives_as_two_datagrams(bench: Bench) -> None:
    whole = len(bench.receive()[1])
    bench.begin("split", "out", share=1.0, delay=0.004, seed=1)
    assert max(len(data) for data in bench.many(20)[2:]) < whole


def test_garbage_arrives_between_the_messages(bench: Bench) -> None:
    bench.begin("garbage", "out", share=1.0, count=40, seed=1)
    rows = bench.many(40)
    assert sum(len(data) == 40 for data in rows) >= 15
    whole = [data for data in rows if len(data) > 60]
    assert np.diff(sequence(whole)).min() == 1


def test_frozen_controller_repeats_one_message(bench: Bench) -> None:
    bench.begin("freeze")
    rows = bench.many(20)
    assert len(set(rows[1:])) == 1
    bench.arm.end_fault(1)
    assert len(set(bench.many(20)[2:])) > 15


def test_stalled_arm_reports_that_it_follows_and_does_not_move(bench: Bench) -> None:
    bench.many(20, goal=0.0)
    bench.begin("stall")
    last = bench.many(60, goal=0.002)[-1]
    assert abs(height(last)) < 1e-6 and parsed(last).mciState.state == 3  # running
    bench.arm.end_fault(1)
    assert height(bench.many(100, goal=0.002)[-1]) > 0.001


def test_motors_off_and_a_stopped_program_are_reported(bench: Bench) -> None:
    bench.many(20, goal=0.0)
    bench.arm.motors(False)
    bench.arm.rapid(False)
    state = parsed(bench.many(10, goal=0.0)[-1])
    assert (state.motorState.state, state.mciState.state, state.rapidExecState.state) == (2, 2, 1)


def test_silent_arm_sends_nothing(bench: Bench) -> None:
    bench.arm.silence(0.5)
    bench.socket.settimeout(0.25)
    with pytest.raises(TimeoutError):
        while True:
            bench.receive()
    bench.socket.settimeout(5.0)
    bench.receive()


def test_restarted_count_begins_at_zero(bench: Bench) -> None:
    bench.many(20)
    bench.arm.restart_sequence()
    assert min(sequence(bench.many(20))) < 10


def test_a_disconnected_arm_is_silent_until_the_last_fault_ends(bench: Bench) -> None:
    devices = Devices(bench.arm, None, (), None)  # type: ignore[arg-type]
    faults = [Fault("arm", "disconnect", at=1, duration=duration) for duration in (math.inf, 0.001)]
    for number, fault in enumerate(faults):
        devices.begin(number, fault)
    devices.end(1, faults[1])
    sent = bench.arm.report.sent
    bench.socket.settimeout(0.25)
    with pytest.raises(TimeoutError):
        bench.many(200, goal=0.0)
    assert bench.arm.report.sent == sent and bench.arm.report.answers == 0
    devices.end(0, faults[0])
    bench.socket.settimeout(5.0)
    bench.receive()
