"""The mock robot executes its fault plan: clients see each fault begin and end at the planned times and events."""

import os
import socket
import struct
import time
import urllib.request
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

from gelflow.clock import ScaledClock
from gelflow.errors import UsageError
from gelflow.hardware_mocks.faults.injector import Devices, Occurrence
from gelflow.hardware_mocks.faults.plan import Fault, FaultPlan
from gelflow.hardware_mocks.robot import MockRobot, MockRobotConfig
from gelflow.hardware_mocks.simulated_cell.cell import SimulatedCell, SimulatedCellConfig
from gelflow.hardware_mocks.simulated_cell.insertion_progress import InsertionProgress
from gelflow.real.wsg.codec import Packet
from gelflow.real.wsg.constants import Command
from gelflow.task import INSERTION


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def brightness(url: str) -> float:
    with urllib.request.urlopen(url.replace("stream", "snapshot"), timeout=5) as answer:
        image = cv2.imdecode(np.frombuffer(answer.read(), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return float(np.mean(image))


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end, "the condition was not met in time"
        time.sleep(0.01)


def test_faults_begin_at_their_time_and_event_and_end_after_their_duration() -> None:
    plan = FaultPlan(
        (
            Fault("left_camera", "blacken", at=0.5, duration=1.0),
            Fault("gripper", "lose_part", event="gripped", after=0.3),
            Fault("arm", "emergency_stop", event="descent"),  # does not come
        )
    )
    with MockRobot(2.0, MockRobotConfig(egm_port=free_port(), faults=plan)) as robot:
        time.sleep(0.5)
        assert robot.faults.log == []  # time 0 of a plan is the first command
        assert brightness(robot.cameras[0].url) > 50
        wait_for(lambda: robot.cell.truth()["part"] is not None)
        descriptor = os.open(robot.gripper.serial_path, os.O_RDWR | os.O_NOCTTY)
        try:
            os.write(descriptor, Packet(Command.SET_FORCE_LIMIT, struct.pack("<f", 12.0)).encode())
            os.write(descriptor, Packet(Command.HOME, b"\x01").encode())
            wait_for(lambda: brightness(robot.cameras[0].url) < 6)
            assert brightness(robot.cameras[1].url) > 50
            wait_for(lambda: brightness(robot.cameras[0].url) > 50)
            wait_for(lambda: robot.cell.gripper_state()[0] > 0.109)
            time.sleep(0.2)
            os.write(descriptor, Packet(Command.GRASP, struct.pack("<ff", 35.0, 200.0)).encode())
            wait_for(lambda: len(robot.faults.log) == 3)
        finally:
            os.close(descriptor)
        log = {(entry["fault"].split()[1], entry["what"]): entry["time"] for entry in robot.faults.log}
        assert set(log) == {("blacken", "begin"), ("blacken", "end"), ("lose_part", "begin")}
        assert 0.9 < log["blacken", "end"] - log["blacken", "begin"] < 1.5
        started = robot.cell.progress().started
        assert 0.45 < log["blacken", "begin"] - started < 1.0
        assert robot.cell.progress().attempts == 0


def test_grip_friction_and_gel_stiffness_change_while_the_cell_runs() -> None:
    cell = SimulatedCell(ScaledClock(), SimulatedCellConfig(seed=3))
    cell.advance(100)
    cell.command_gripper(width=0.032, speed=0.1, force=12.0)
    cell.advance(120)
    held = np.abs(cell.marker_displacement(0)).mean()
    cell.change_world(gel_stiffness=10.0, pad_friction=1.0)
    cell.advance(50)
    assert np.abs(cell.marker_displacement(0)).mean() < 0.3 * held
    cell.change_world(gel_stiffness=1.0, pad_friction=0.001)
    cell.advance(50)
    assert cell.truth()["part"]["largest_slip"] > 5e-3  # the part falls


def test_a_momentary_fault_at_random_times_occurs_again_and_again() -> None:
    occurrence = Occurrence(0, Fault("gripper", "lose_part", rate=2.0, seed=1), INSERTION)
    progress = InsertionProgress(started=0.0)
    times = [step / 100 for step in range(1000) if occurrence.begins(step / 100, progress)]
    assert 10 < len(times) < 35 and not occurrence.active
    lasting = Occurrence(0, Fault("gripper", "stall", rate=2.0, seed=1, duration=0.5), INSERTION)
    begins, ends = 0, 0
    for step in range(1000):
        ends += lasting.ends(step / 100)
        begins += lasting.begins(step / 100, progress)
    assert 5 < begins <= ends + 1 <= begins + 1


class RecordingDevice:
    """Notes the calls of its methods."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = []

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *values, **named: self.calls.append((name, values, named))


def test_overlapping_faults_end_one_by_one() -> None:
    arm, cell = RecordingDevice(), RecordingDevice()
    devices = Devices(arm, RecordingDevice(), (), cell)  # type: ignore[arg-type]
    emergency, program = Fault("arm", "emergency_stop", at=1), Fault("arm", "rapid_stop", at=1)
    stiff, slip = Fault("world", "stiff_gel", at=1), Fault("world", "slip", at=1)
    devices.begin(0, emergency)
    devices.begin(1, program)
    devices.end(0, emergency)
    assert arm.calls[-2:] == [("motors", (True,), {}), ("rapid", (False,), {})]
    devices.end(1, program)
    assert arm.calls[-2:] == [("motors", (True,), {}), ("rapid", (True,), {})]
    devices.begin(2, stiff)
    devices.begin(3, slip)
    assert cell.calls[-1] == ("change_world", (), {"gel_stiffness": 5.0, "pad_friction": 0.2})
    devices.end(2, stiff)
    assert cell.calls[-1] == ("change_world", (), {"gel_stiffness": 1.0, "pad_friction": 0.2})


class RefusingCell:
    """Refuses a stiffness of the gels above 10."""

    def __init__(self) -> None:
        self.stiffness = 1.0

    def change_world(self, *, gel_stiffness: float, pad_friction: float) -> None:
        if gel_stiffness > 10:
            raise UsageError("too stiff")
        self.stiffness = gel_stiffness


def test_a_refused_world_does_not_act_on_later_faults() -> None:
    cell = RefusingCell()
    devices = Devices(RecordingDevice(), RecordingDevice(), (), cell)  # type: ignore[arg-type]
    refused = Fault("world", "stiff_gel", at=1, parameters={"factor": 20.0})
    with pytest.raises(UsageError, match="too stiff"):
        devices.begin(0, refused)
    devices.begin(1, Fault("world", "stiff_gel", at=1))
    assert cell.stiffness == 5.0
    devices.end(0, refused)
    assert cell.stiffness == 5.0
