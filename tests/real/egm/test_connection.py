"""EGM driver: connection, helper process and foreign messages."""

import contextlib
import dataclasses
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.real.egm.harness import CONFIG, DOWN, MOCK, START, ArmAndMock, free_port, near_start

from gelflow import interrupts
from gelflow.clock import ScaledClock
from gelflow.errors import PeerError, PeerTimeout, SafetyError, UsageError
from gelflow.hardware_mocks.egm.device import MockEgmArm
from gelflow.hardware_mocks.plant import KinematicArm
from gelflow.real.egm.codec import EgmFeedback, decode_sensor, encode_robot
from gelflow.real.egm.driver import EgmArm
from gelflow.real.kinematics import HOME, inverse


@pytest.fixture
def cell() -> Iterator[ArmAndMock]:
    with ArmAndMock() as cell:
        yield cell


def test_driver_may_start_before_the_robot() -> None:
    cell = ArmAndMock(5.0)
    failed: list[BaseException] = []

    def connect() -> None:
        try:
            cell.arm.connect(timeout=200)
        except PeerError as error:
            failed.append(error)

    waiting = threading.Thread(target=connect)
    waiting.start()
    try:
        cell.until(lambda: cell.arm.pid is not None, "the process")
        time.sleep(0.3)
        cell.mock.start()
        waiting.join(30)
        assert not failed
        cell.arm.wait_following(60)
    finally:
        waiting.join(45)
        cell.__exit__()


def test_missing_robot_gives_a_one_line_error_and_ends_the_process() -> None:
    arm = EgmArm(dataclasses.replace(CONFIG, port=free_port(), connect_timeout=2.0), clock=ScaledClock(10))
    for _ in range(2):
        with pytest.raises(PeerTimeout) as caught:
            arm.connect()
        assert str(caught.value) == (
            f"no EGM message on UDP port {arm.port} within 2 s: "
            "start the RAPID program with EGMRunPose, check UCDevice address"
        )
        assert arm.pid is None
    with pytest.raises(UsageError, match="not connected"):
        arm.state()


def test_a_deferred_signal_ends_the_wait_for_the_robot() -> None:
    arm = EgmArm(dataclasses.replace(CONFIG, port=free_port()), clock=ScaledClock())
    timer = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT))
    begun = time.monotonic()
    with pytest.raises(interrupts.Interrupted), interrupts.interruptible():
        timer.start()
        with interrupts.deferred():
            arm.connect(timeout=120)
    assert time.monotonic() - begun < 60 and arm.pid is None


def test_port_in_use_is_reported() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        with pytest.raises(UsageError, match=f"cannot listen for EGM on 127.0.0.1:{port}: Address already in use"):
            EgmArm(dataclasses.replace(CONFIG, port=port), clock=ScaledClock()).connect()


def test_an_address_on_which_nothing_can_listen_is_reported() -> None:
    """192.0.2.1 is reserved for documentation; names with an empty part or NUL are refused before a socket is used."""
    arm = EgmArm(dataclasses.replace(CONFIG, host="192.0.2.1"), clock=ScaledClock())
    with pytest.raises(UsageError, match=r"on 192\.0\.2\.1:\d+: .*; host must be an IPv4 address") as caught:
        arm.connect()
    assert "another program" not in str(caught.value)
    for host in ("192.168.1..5", "\u00e4..b", "a\0b"):
        with pytest.raises(UsageError, match="host must be an IPv4 address of this computer"):
            dataclasses.replace(CONFIG, host=host)


def test_killed_egm_process_is_detected(cell: ArmAndMock) -> None:
    assert cell.arm.pid is not None
    os.kill(cell.arm.pid, signal.SIGKILL)
    said = ""

    def refused() -> bool:
        nonlocal said
        try:
            cell.arm.target(START, DOWN, lifetime=0.5)
        except PeerError as error:
            said = str(error)
        return bool(said)

    cell.until(refused, "a target is refused")
    assert "the EGM process has ended (exit status -9)" in said
    cell.arm.stop("the end")


def test_egm_process_ignores_interrupts(cell: ArmAndMock) -> None:
    assert cell.arm.pid is not None
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        os.kill(cell.arm.pid, number)
    cell.clock.sleep(0.1)
    cell.go(near_start(0.001, 0, 0))


def _has_ended(pid: int | None) -> bool:
    with contextlib.suppress(OSError):
        # A zombie process has ended too.
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    return True


PARENT_SCRIPT = """
import sys, time
import numpy as np
from gelflow.clock import ScaledClock
from gelflow.hardware_mocks import KinematicArm, MockEgmArm, MockEgmConfig
from gelflow.real import EgmArm, EgmConfig
clock = ScaledClock()
port = int(sys.argv[1])
plant = KinematicArm(clock, position=np.array([0.4, 0.0, 0.3]), quaternion=np.array([0.0, 0.0, 1.0, 0.0]))
mock = MockEgmArm(plant, clock=clock, config=MockEgmConfig(port=port))
mock.start()
arm = EgmArm(EgmConfig((0.3, -0.1, 0.2), (0.5, 0.1, 0.4), port=port, stale=1.0, silence=5.0), clock=clock)
arm.connect(timeout=60)
arm.wait_following(60)
print(arm.pid, mock.pid, flush=True)
time.sleep(600)
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_helper_processes_end_with_their_parent() -> None:
    port = free_port()
    command = [sys.executable, "-c", PARENT_SCRIPT, str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        children = [int(word) for word in parent.stdout.readline().split()]
        assert len(children) == 2
        assert not any(map(_has_ended, children))
        parent.send_signal(signal.SIGKILL)
    end = time.monotonic() + 10
    while not all(map(_has_ended, children)):
        assert time.monotonic() < end, "a helper process outlived its parent"
        time.sleep(0.01)


def test_invalid_duplicate_and_foreign_messages_are_counted_and_ignored() -> None:
    """The test sends the messages of the robot: each valid message is answered once, others are not answered."""
    port = free_port()
    arm = EgmArm(dataclasses.replace(CONFIG, port=port), clock=ScaledClock())
    joints = inverse(tuple(START), tuple(DOWN), near=HOME)

    def message(sequence: int) -> bytes:
        return encode_robot(EgmFeedback(sequence, sequence * 0.004, tuple(START), tuple(DOWN), joints))

    with contextlib.ExitStack() as stack:
        robot, stranger = (stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2))
        stack.callback(arm.close)
        for one in (robot, stranger):
            one.bind(("127.0.0.1", 0))
            one.settimeout(10)
            done = threading.Event()

        def call() -> None:
            while not done.wait(0.02):
                robot.sendto(message(1), ("127.0.0.1", port))

        caller = threading.Thread(target=call)
        caller.start()
        try:
            arm.connect(timeout=60)
        finally:
            done.set()
            caller.join()
        answer = decode_sensor(robot.recv(4096))
        assert answer.sequence == 0
        assert answer.position == pytest.approx(tuple(START))
        before = arm.counts
        robot.sendto(b"\x00" * 7, ("127.0.0.1", port))
        robot.sendto(b"", ("127.0.0.1", port))
        robot.sendto(message(1), ("127.0.0.1", port))
        robot.sendto(message(2)[:40], ("127.0.0.1", port))
        stranger.sendto(message(3), ("127.0.0.1", port))
        robot.sendto(message(2), ("127.0.0.1", port))
        answer = decode_sensor(robot.recv(4096))
        assert answer.sequence == 1
        counts = arm.counts
        assert counts.malformed - before.malformed == 3
        assert counts.foreign == 1
        assert counts.duplicates - before.duplicates == 1
        robot.settimeout(0.2)
        with pytest.raises(TimeoutError):
            robot.recv(4096)
        assert [r.sequence for r in arm.drain_log()] == [1, 2]
        assert any(e.kind == "malformed" and "EgmRobot" in e.text for e in arm.drain_events())


def robot_message(sequence: int, **changes: str) -> bytes:
    joints = inverse(tuple(START), tuple(DOWN), near=HOME)
    whole = EgmFeedback(sequence, sequence * 0.004, tuple(START), tuple(DOWN), joints)
    return encode_robot(dataclasses.replace(whole, **changes))  # type: ignore[arg-type]


@pytest.mark.parametrize("following", [False, True])
def test_egm_that_starts_again_from_another_port_is_followed(following: bool) -> None:
    """Only where the sender before it is silent and the controller did not follow references; never from another IP."""
    arm = EgmArm(
        dataclasses.replace(CONFIG, port=free_port(), host="0.0.0.0", stale=0.5, silence=1.0), clock=ScaledClock()
    )
    with contextlib.ExitStack() as stack:
        stack.callback(arm.close)
        first, again, stranger = (
            stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(3)
        )
        for one, address in ((first, "127.0.0.1"), (again, "127.0.0.1"), (stranger, "127.0.0.2")):
            one.bind((address, 0))

        def send(sender: socket.socket, count: int, mci: str = "running") -> None:
            for sequence in range(count):
                if not ended.is_set() or sender is not first:
                    sender.sendto(robot_message(sequence, mci=mci), ("127.0.0.1", arm.port))
                    time.sleep(0.004)

        ended = threading.Event()
        caller = threading.Thread(target=send, args=(first, 20_000, "running" if following else "stopped"))
        stack.callback(caller.join)
        stack.callback(ended.set)
        arm._start()
        caller.start()
        arm._wait_first_message(60)
        send(again, 3)  # the first one is not silent
        arm._wait(lambda: arm.counts.foreign == 3, 10, "the messages of another port were not ignored")
        ended.set()
        time.sleep(1.2)
        send(stranger, 50)
        with pytest.raises((PeerTimeout, SafetyError), match=r"of other senders were ignored|is stopped"):
            arm.wait_following(0.1)
        send(again, 100)
        if following:
            with pytest.raises(SafetyError, match="no EGM message"):
                arm.wait_following(0.1)
            arm._wait(lambda: arm.counts.foreign == 153, 10, "the messages of another port were not ignored")
        else:
            arm.wait_following(10)


def test_messages_of_other_addresses_than_the_configured_robot_are_ignored() -> None:
    port = free_port()
    arm = EgmArm(dataclasses.replace(CONFIG, port=port, robot="192.0.2.1"), clock=ScaledClock(10))
    plant = KinematicArm(ScaledClock(10), position=START, quaternion=DOWN)
    mock = MockEgmArm(plant, clock=ScaledClock(10), config=dataclasses.replace(MOCK, port=port))
    mock.start()
    try:
        with pytest.raises(PeerTimeout, match="no EGM message"):
            arm.connect(timeout=3)
    finally:
        mock.stop()
