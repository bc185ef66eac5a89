"""Mock WSG-50 on pty and TCP, with a client that shares no code with the driver and its codec."""

import os
import select
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import pytest
from tests.hardware_mocks.wsg.harness import checksum

from gelflow.clock import ScaledClock
from gelflow.errors import UsageError
from gelflow.hardware_mocks.plant import KinematicGripper
from gelflow.hardware_mocks.wsg.device import MockWsgGripper
from gelflow.hardware_mocks.wsg.finger_controller import MockWsgConfig

CLOCK = ScaledClock(5.0)
PATIENT = 10.0  # time-out that only a failing test reaches [s, wall]
HOME, MOVE, STOP, FAST_STOP, ACK, GRASP, RELEASE = range(0x20, 0x27)
SUCCESS, PENDING, DENIED, FAILED, BLOCKED, RANGE = 0, 26, 16, 18, 29, 28


def packet(command: int, layout: str = "<", *values: float | bytes) -> bytes:
    payload = struct.pack(layout, *values)
    head = b"\xaa\xaa\xaa" + struct.pack("<BH", command, len(payload)) + payload
    return head + struct.pack("<H", checksum(head))


class Client:
    """A blocking, strict client: any unexpected byte fails the test."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor

    def send(self, data: bytes) -> None:
        os.write(self.descriptor, data)

    def exactly(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            ready, _, _ = select.select([self.descriptor], [], [], PATIENT)
            assert ready, f"the mock did not answer (so far {data!r})"
            data += os.read(self.descriptor, count - len(data))
        return data

    def reply(self) -> tuple[int, int, bytes]:
        head = self.exactly(6)
        assert head[:3] == b"\xaa\xaa\xaa"
        command, length = struct.unpack_from("<BH", head, 3)
        rest = self.exactly(length + 2)
        assert checksum(head + rest) == 0
        return command, struct.unpack_from("<H", rest)[0], rest[2:-2]

    def ask(self, command: int, layout: str = "<", *values: float | bytes) -> tuple[int, bytes]:
        self.send(packet(command, layout, *values))
        answered, status, data = self.reply()
        assert answered == command
        return status, data

    def result(self, command: int, layout: str = "<", *values: float | bytes) -> int:
        """The final status of a motion, which must be pending first."""
        status, _ = self.ask(command, layout, *values)
        assert status == PENDING
        answered, status, _ = self.reply()
        assert answered == command
        return status

    def width(self) -> float:
        status, data = self.ask(0x43, "<BH", 0, 20)
        assert status == SUCCESS
        return float(struct.unpack("<f", data)[0])

    def flags(self) -> int:
        return int(struct.unpack("<I", self.ask(0x40, "<BH", 0, 20)[1])[0])

    def grasp_state(self) -> int:
        return self.ask(0x41, "<BH", 0, 20)[1][0]


@contextmanager
def line(mock: MockWsgGripper) -> Iterator[Client]:
    descriptor = os.open(mock.serial_path, os.O_RDWR | os.O_NOCTTY)
    try:
        yield Client(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def port(mock: MockWsgGripper) -> Iterator[Client]:
    with socket.create_connection(mock.tcp_address) as connection:
        yield Client(connection.fileno())


@contextmanager
def serving(
    *, width: float = 0.050, part: float | None = None, config: MockWsgConfig | None = None
) -> Iterator[tuple[MockWsgGripper, KinematicGripper]]:
    plant = KinematicGripper(CLOCK, width=width, part_width=part)
    with MockWsgGripper(plant, clock=CLOCK, config=config, tcp_port=0) as mock:
        yield mock, plant


Wire = Callable[[MockWsgGripper], AbstractContextManager[Client]]
WIRES = pytest.mark.parametrize("wire", [line, port])


def test_known_requests_get_known_replies() -> None:
    with serving() as (mock, _), line(mock) as client:
        client.send(bytes.fromhex("aa aa aa 20 01 00 00 8f 83"))
        assert client.exactly(10) == bytes.fromhex("aa aa aa 20 02 00 1a 00 fc 32")
        assert client.reply()[:2] == (HOME, SUCCESS)
    with serving(width=0.050) as (mock, _), port(mock) as client:
        client.send(bytes.fromhex("aa aa aa 43 03 00 01 14 00 36 8d"))
        for _ in range(3):  # at once, then every 20 ms
            assert client.exactly(14) == bytes.fromhex("aa aa aa 43 06 00 00 00 00 00 48 42 62 ff")


@WIRES
def test_home_move_grasp_release(wire: Wire) -> None:
    with serving() as (mock, plant), wire(mock) as client:
        assert client.ask(MOVE, "<Bff", 0, 80.0, 100.0)[0] == 3  # NOT_INITIALIZED
        assert not client.flags() & 1
        assert client.result(HOME, "<B", 1) == SUCCESS
        assert client.flags() & 1 and client.width() == pytest.approx(110, abs=0.3)
        assert client.result(MOVE, "<Bff", 0, 40.0, 400.0) == SUCCESS
        assert client.width() == pytest.approx(40, abs=0.3)
        plant.set_part(0.020)
        assert client.ask(0x32, "<f", 25.0)[0] == SUCCESS
        assert struct.unpack("<f", client.ask(0x33)[1]) == (25.0,)
        assert client.result(GRASP, "<ff", 20.0, 200.0) == SUCCESS
        assert client.grasp_state() == 4 and client.width() == pytest.approx(20, abs=0.1)
        assert struct.unpack("<f", client.ask(0x45, "<BH", 0, 20)[1]) == (25.0,)
        assert client.ask(GRASP, "<ff", 20.0, 200.0)[0] == 4  # ALREADY_RUNNING: it holds
        assert client.result(RELEASE, "<ff", 60.0, 400.0) == SUCCESS
        assert client.grasp_state() == 0


def test_grasp_requires_contact_within_its_band() -> None:
    with serving(width=0.060) as (mock, plant), line(mock) as client:
        assert client.result(HOME, "<B", 0) == SUCCESS
        assert client.result(GRASP, "<ff", 30.0, 400.0) == FAILED  # no part
        assert client.grasp_state() == 2 and client.width() == pytest.approx(27, abs=0.3)
        assert client.flags() & 1 << 18
        assert client.result(RELEASE, "<ff", 110.0, 400.0) == SUCCESS
        plant.set_part(0.036)  # contact 6 mm before the nominal width: outside the band
        assert client.result(GRASP, "<ff", 30.0, 400.0) == BLOCKED
        assert client.grasp_state() == 7 and client.flags() & 1 << 2
        assert client.result(RELEASE, "<ff", 110.0, 400.0) == SUCCESS
        assert client.result(GRASP, "<ff", 35.0, 400.0) == SUCCESS  # 1 mm before: inside
        assert client.result(RELEASE, "<ff", 110.0, 400.0) == SUCCESS
        assert client.result(MOVE, "<Bff", 0, 20.0, 400.0) == BLOCKED


def test_removed_part_is_reported_as_lost() -> None:
    with serving() as (mock, plant), line(mock) as client:
        client.result(HOME, "<B", 1)
        plant.set_part(0.025)
        assert client.result(GRASP, "<ff", 25.0, 400.0) == SUCCESS
        plant.set_part(None)
        end = time.monotonic() + PATIENT
        while client.grasp_state() != 3:
            assert time.monotonic() < end, "the loss was not seen"
        plant.set_part(None)
        assert client.result(RELEASE, "<ff", 100.0, 400.0) == SUCCESS
        plant.set_part(0.025)
        assert client.result(GRASP, "<ff", 25.0, 400.0) == SUCCESS
        mock.lose_part()
        assert client.grasp_state() == 3


def test_fast_stop_locks_until_acknowledged_and_stop_ends_a_motion() -> None:
    with serving() as (mock, _), line(mock) as client:
        assert client.result(HOME, "<B", 1) == SUCCESS
        assert client.ask(MOVE, "<Bff", 0, 10.0, 5.0)[0] == PENDING
        assert client.ask(MOVE, "<Bff", 0, 50.0, 5.0)[0] == 4  # ALREADY_RUNNING
        client.send(packet(STOP))
        assert {client.reply()[:2], client.reply()[:2]} == {(MOVE, 19), (STOP, SUCCESS)}  # CMD_ABORTED
        assert client.flags() & 1 << 6 and client.width() > 100
        assert client.ask(FAST_STOP)[0] == SUCCESS
        assert client.flags() & 1 << 12 and client.grasp_state() == 7
        for command, layout, values in (
            (HOME, "<B", (1,)),
            (MOVE, "<Bff", (0, 50.0, 100.0)),
            (GRASP, "<ff", (50.0, 100.0)),
            (RELEASE, "<ff", (50.0, 100.0)),
        ):
            assert client.ask(command, layout, *values)[0] == DENIED
        assert client.ask(ACK, "<3s", b"nak")[0] == 24  # INVALID_PARAMETER
        assert client.flags() & 1 << 12
        assert client.ask(ACK, "<3s", b"ack")[0] == SUCCESS
        assert not client.flags() & 1 << 12
        assert client.result(MOVE, "<Bff", 0, 100.0, 400.0) == SUCCESS


def test_only_an_unannounced_close_raises_fast_stop() -> None:
    with serving() as (mock, _):
        with port(mock) as client:
            assert client.ask(0x07)[0] == SUCCESS
        with port(mock) as client:  # a client is accepted after the previous one has disconnected
            assert not client.flags() & 1 << 12
        end = time.monotonic() + PATIENT
        while not mock.fast_stopped:
            assert time.monotonic() < end, "no FAST STOP after an unannounced close"
            time.sleep(0.005)
        with port(mock) as client:
            assert client.ask(HOME, "<B", 1)[0] == DENIED
    with serving(config=MockWsgConfig(fast_stop_on_disconnect=False)) as (mock, _):
        with port(mock) as client:
            client.flags()
        with port(mock) as client:
            assert client.result(HOME, "<B", 1) == SUCCESS


def test_second_client_is_rejected() -> None:
    with serving() as (mock, _), port(mock) as client:
        client.flags()
        with socket.create_connection(mock.tcp_address, PATIENT) as second:
            assert second.recv(1) == b""
        assert client.width() == 50.0


def test_periodic_updates_are_sent_between_replies_until_cancelled() -> None:
    with serving() as (mock, _), line(mock) as client:
        assert client.ask(0x44, "<BH", 1, 10)[0] == SUCCESS
        client.send(packet(HOME, "<B", 1))
        seen = [client.reply()[:2]]
        while seen[-1] != (HOME, SUCCESS):
            seen.append(client.reply()[:2])
        assert (HOME, PENDING) in seen and seen.count((0x44, SUCCESS)) > 20
        client.send(packet(0x44, "<BH", 0, 10) + packet(0x06, "<2s", b"hi"))
        while (answer := client.reply())[0] == 0x44:
            pass
        assert answer == (0x06, SUCCESS, b"hi")
        ready, _, _ = select.select([client.descriptor], [], [], 0.1)
        assert not ready


def test_on_change_updates_are_sent_only_after_a_change() -> None:
    with serving() as (mock, _), line(mock) as client:
        assert client.ask(0x43, "<BH", 3, 100)[0] == SUCCESS
        ready, _, _ = select.select([client.descriptor], [], [], 0.2)
        assert not ready
        client.send(packet(HOME, "<B", 1))
        answers = [client.reply()]
        while answers[-1][:2] != (HOME, SUCCESS):
            answers.append(client.reply())
        widths = [struct.unpack("<f", data)[0] for command, _, data in answers if command == 0x43]
        # 60 mm at 60 mm/s with at least 100 ms between updates
        assert 2 <= len(widths) <= 14 and widths == sorted(widths)


def test_soft_limits_apply_until_homing_clears_them() -> None:
    with serving() as (mock, _), line(mock) as client:
        client.result(HOME, "<B", 1)
        assert client.ask(0x34, "<ff", 20.0, 10.0)[0] == RANGE
        assert client.ask(0x34, "<ff", 20.0, 90.0)[0] == SUCCESS
        assert struct.unpack("<ff", client.ask(0x35)[1]) == pytest.approx((20.0, 90.0))
        assert client.ask(MOVE, "<Bff", 0, 10.0, 100.0)[0] == RANGE
        assert client.flags() & 1 << 4
        client.result(HOME, "<B", 1)
        assert client.result(MOVE, "<Bff", 0, 100.0, 400.0) == SUCCESS
        assert client.ask(0x34, "<ff", 20.0, 90.0)[0] == SUCCESS
        assert client.ask(0x36)[0] == SUCCESS
        assert struct.unpack("<ff", client.ask(0x35)[1]) == pytest.approx((0.0, 110.0))


@pytest.mark.parametrize(
    ("command", "layout", "values", "status"),
    [
        (MOVE, "<Bff", (1, 50.0, 100.0), 24),  # flags other than 0
        (MOVE, "<Bff", (0, 111.0, 100.0), RANGE),
        (MOVE, "<Bff", (0, 50.0, 4.0), RANGE),
        (MOVE, "<Bff", (0, 50.0, 421.0), RANGE),
        (MOVE, "<Bff", (0, float("nan"), 100.0), 24),
        (MOVE, "<Bf", (0, 50.0), 13),
        (GRASP, "<fff", (50.0, 50.0, 50.0), 15),
        (STOP, "<B", (1,), 12),
        (HOME, "<B", (3,), 24),
        (0x30, "<f", (99.0,), RANGE),
        (0x32, "<f", (81.0,), RANGE),
        (0x38, "<", (), 1),  # no force-measuring fingers
        (0x43, "<BH", (1, 9), RANGE),
        (0x43, "<BH", (2, 50), 24),
        (0x77, "<", (), 14),
    ],
)
def test_invalid_requests_get_their_status(command: int, layout: str, values: tuple[float, ...], status: int) -> None:
    with serving() as (mock, _), line(mock) as client:
        assert client.result(HOME, "<B", 1) == SUCCESS
        assert client.ask(command, layout, *values)[0] == status


def test_device_info_limits_and_settings() -> None:
    with serving() as (mock, _), line(mock) as client:
        assert struct.unpack("<BBHI", client.ask(0x50)[1])[0] == 1
        limits = struct.unpack("<8f", client.ask(0x53)[1])
        assert limits == pytest.approx((110, 5, 420, 100, 5000, 5, 80, 120))
        assert client.ask(0x30, "<f", 2000.0)[0] == SUCCESS
        assert struct.unpack("<f", client.ask(0x31)[1]) == pytest.approx((2000.0,))
        assert client.ask(0x46)[0] == SUCCESS and len(client.ask(0x46)[1]) == 2


def test_corrupted_bytes_are_tolerated() -> None:
    with serving() as (mock, _), line(mock) as client:
        good = packet(0x06, "<4s", b"echo")
        client.send(good[:-1] + bytes([good[-1] ^ 1]))
        assert client.reply()[:2] == (0x06, 11)  # CHECKSUM_ERROR
        client.send(b"\x00\xaa\xaagarbage\xff\xaa" + good)
        assert client.reply() == (0x06, SUCCESS, b"echo")
        for byte in good:
            client.send(bytes([byte]))
        assert client.reply() == (0x06, SUCCESS, b"echo")
        client.send(b"\xaa\xaa\xaa\x06\x40")  # an incomplete header
        time.sleep(CLOCK.wall(1.5))
        client.send(good)
        assert client.reply() == (0x06, SUCCESS, b"echo")


def test_device_without_checksums_accepts_zeros() -> None:
    with serving(config=MockWsgConfig(crc=False)) as (mock, _), line(mock) as client:
        client.send(packet(STOP)[:-2] + b"\0\0")
        assert client.exactly(10) == b"\xaa\xaa\xaa" + struct.pack("<BHHH", STOP, 2, SUCCESS, 0)


def test_fast_commands_get_overrun_except_stop() -> None:
    with serving(config=MockWsgConfig(shortest_command_interval=5.0)) as (mock, _), line(mock) as client:
        assert client.ask(0x50)[0] == SUCCESS
        assert client.ask(0x50)[0] == 27
        assert client.ask(STOP)[0] == SUCCESS


def test_misuse_of_the_mock_raises_usage_error() -> None:
    plant = KinematicGripper(CLOCK)
    with pytest.raises(UsageError, match="pty"):
        MockWsgGripper(plant, clock=CLOCK, serial=False)
    with serving() as (mock, _):
        with pytest.raises(UsageError, match="listen"):
            MockWsgGripper(plant, clock=CLOCK, tcp_port=mock.tcp_address[1]).open()
        with pytest.raises(UsageError, match="already open"):
            mock.open()
        assert mock.addresses == (f"serial:{mock.serial_path}", f"tcp:127.0.0.1:{mock.tcp_address[1]}")


def test_a_part_stays_clamped_however_often_the_fingers_are_stopped() -> None:
    with serving() as (mock, plant), line(mock) as client:
        client.result(HOME, "<B", 1)
        plant.set_part(0.020)
        assert client.ask(0x32, "<f", 25.0)[0] == SUCCESS
        assert client.result(GRASP, "<ff", 20.0, 200.0) == SUCCESS
        for command in (STOP, STOP, FAST_STOP, FAST_STOP):
            assert client.ask(command)[0] == SUCCESS
            assert plant.gripper_state()[2] == 25.0
        assert client.ask(ACK, "<3s", b"ack")[0] == SUCCESS
        assert client.result(RELEASE, "<ff", 60.0, 400.0) == SUCCESS
        assert client.ask(STOP)[0] == SUCCESS
        assert plant.gripper_state()[2] == 0.0
