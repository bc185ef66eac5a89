"""WSG-50 driver: corrupted byte streams, and peers that are absent, silent or of another type."""

import itertools
import os
import socket
import threading
import tty
from collections.abc import Iterable

import pytest
from tests.real.wsg.harness import CLOCK, CONFIG, Corruption, connected, eventually, mock, relayed

from gelflow.errors import PeerError, PeerRefused, PeerTimeout, SafetyError
from gelflow.real.transport import TcpTransport, transport_for
from gelflow.real.wsg.codec import crc16, reply
from gelflow.real.wsg.config import WsgConfig
from gelflow.real.wsg.constants import STATE_COMMANDS, Command, Status
from gelflow.real.wsg.driver import WsgGripper


def split(data: bytes) -> Iterable[bytes]:
    return (bytes([byte]) for byte in data)


def duplicated(data: bytes) -> Iterable[bytes]:
    """Every packet twice."""
    parts = data.split(b"\xaa\xaa\xaa")
    yield parts[0] + b"".join(2 * (b"\xaa\xaa\xaa" + part) for part in parts[1:])


def with_garbage(data: bytes) -> Iterable[bytes]:
    yield b"\x00\xff\xaaxyz" + data.replace(b"\xaa\xaa\xaa", b"\x01\xaa\xaa\xaa\xaa") + b"\xaa\xaa"


@pytest.mark.parametrize("corrupt", [split, duplicated, with_garbage])
def test_split_duplicated_and_garbage_bytes_are_tolerated(corrupt: Corruption) -> None:
    with relayed(corrupt) as (gripper, _, plant):
        gripper.home()
        plant.set_part(0.040)
        gripper.grasp(width=0.040, speed=0.4, force=20)
        assert gripper.state().grasp == "holding" and gripper.state().fault == ""
        gripper.release(width=0.1, speed=0.4)
        gripper.move(width=0.08, speed=0.4)
        assert gripper.state().width == pytest.approx(0.08, abs=3e-4)


def test_late_success_of_an_earlier_grasp_is_ignored() -> None:
    late = reply(Command.GRASP, Status.SUCCESS).encode()

    def prepend_late_reply(data: bytes) -> Iterable[bytes]:
        pending = reply(Command.GRASP, Status.CMD_PENDING).encode()
        return [data.replace(pending, late + pending)]

    with relayed(prepend_late_reply) as (gripper, _, _):
        gripper.home()
        with pytest.raises(PeerRefused, match="CMD_FAILED"):
            gripper.grasp(width=0.040, speed=0.4, force=20)


def test_bad_checksum_is_a_fault_until_acknowledged() -> None:
    corrupt = threading.Event()

    def once(data: bytes) -> Iterable[bytes]:
        if corrupt.is_set() and len(data) > 8:
            corrupt.clear()
            return [data[:-1] + bytes([data[-1] ^ 0x10])]
        return [data]

    with relayed(once) as (gripper, _, _):
        gripper.home()
        corrupt.set()
        eventually(lambda: gripper.state().fault == "BAD_CHECKSUM", "the wrong checksum did not appear in the state")
        with pytest.raises(SafetyError, match="BAD_CHECKSUM"):
            gripper.move(width=0.1, speed=0.1)
        gripper.acknowledge_fault()
        gripper.move(width=0.1, speed=0.4)


def test_a_result_that_arrives_after_the_next_command_is_not_taken_for_its_result() -> None:
    late = threading.Event()

    def with_late_result(data: bytes) -> Iterable[bytes]:
        if late.is_set() and reply(Command.PRE_POSITION, Status.CMD_PENDING).encode() in data:
            late.clear()
            return [reply(Command.PRE_POSITION, Status.CMD_ABORTED).encode(), data]
        return [data]

    with relayed(with_late_result) as (gripper, relay, plant):
        gripper.home()
        late.set()
        gripper.move(width=0.060, speed=0.4)
        assert not late.is_set() and plant.gripper_state()[0] == pytest.approx(0.060)
        assert Command.STOP not in relay.ids()


def test_a_result_without_a_first_reply_ends_with_a_stop() -> None:
    """The fingers are blocked and would continue to push."""
    lost = threading.Event()

    def swallow(data: bytes) -> Iterable[bytes]:
        pending = reply(Command.PRE_POSITION, Status.CMD_PENDING).encode()
        if lost.is_set() and pending in data:
            lost.clear()
            return [data.replace(pending, b"")]
        return [data]

    impatient = WsgConfig(reply_timeout=2.0, move_timeout=6.0, home_timeout=50.0, stale_after=3.0)
    with relayed(swallow, config=impatient) as (gripper, relay, plant):
        gripper.home()
        plant.set_part(0.100)
        lost.set()
        with pytest.raises(PeerTimeout, match="PRE_POSITION"):
            gripper.move(width=0.060, speed=0.4)
        assert not lost.is_set() and relay.ids()[-2:] == [Command.PRE_POSITION, Command.STOP]


class TimedTransport(TcpTransport):
    """A TCP connection that records each write and its time."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__(host, port, clock=CLOCK)
        self.writes: list[tuple[float, bytes]] = []

    def write(self, data: bytes) -> None:
        self.writes.append((CLOCK.now(), data))
        super().write(data)


def test_packets_are_sent_in_one_write_with_a_pause_between_commands() -> None:
    with mock() as (server, _):
        transport = TimedTransport(*server.tcp_address)
        with WsgGripper(transport, clock=CLOCK, config=CONFIG) as gripper:
            gripper.home()
    written = [data for _, data in transport.writes]
    assert all(data[:3] == b"\xaa\xaa\xaa" and crc16(data) == 0 for data in written)
    assert [data[3] for data in written] == [
        *(Command.DEVICE_INFO, Command.LIMITS, *STATE_COMMANDS),
        *(Command.HOME, Command.STOP, Command.DISCONNECT),
    ]
    unhurried = [stamp for stamp, data in transport.writes if data[3] != Command.STOP]
    assert min(b - a for a, b in itertools.pairwise(unhurried)) >= CONFIG.command_interval - 1e-6


def test_closed_port_gives_a_one_line_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    gripper = WsgGripper(transport_for(f"tcp:127.0.0.1:{port}", clock=CLOCK), clock=CLOCK)
    with pytest.raises(PeerError, match=f"tcp:127.0.0.1:{port}.*refused.*address") as caught:
        gripper.connect()
    assert "\n" not in str(caught.value)


def test_missing_or_invalid_device_file_gives_a_one_line_error(tmp_path: os.PathLike[str]) -> None:
    plain = os.path.join(tmp_path, "file")
    with open(plain, "w") as file:
        file.write("not a line")
    for path, reason in ((os.path.join(tmp_path, "none"), "no such device"), (plain, plain)):
        with pytest.raises(PeerError, match=reason) as caught:
            WsgGripper(transport_for(f"serial:{path}", clock=CLOCK), clock=CLOCK).connect()
        assert "\n" not in str(caught.value)


def test_serial_line_is_exclusive_to_one_program() -> None:
    with connected() as (_, server, _, _), pytest.raises(PeerError, match="another program"):
        WsgGripper(transport_for(server.addresses[0], clock=CLOCK), clock=CLOCK).connect()


def test_silent_peer_times_out() -> None:
    quick = WsgConfig(reply_timeout=0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp:127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(PeerTimeout, match="DEVICE_INFO"):
            WsgGripper(transport_for(address, clock=CLOCK), clock=CLOCK, config=quick).connect()
    master, slave = os.openpty()
    tty.setraw(slave)
    try:
        address = f"serial:{os.ttyname(slave)}"
        with pytest.raises(PeerTimeout, match="DEVICE_INFO"):
            WsgGripper(transport_for(address, clock=CLOCK), clock=CLOCK, config=quick).connect()
    finally:
        os.close(master)
        os.close(slave)


def test_peer_that_becomes_silent_during_a_motion_times_out_and_receives_a_stop() -> None:
    silent = threading.Event()

    def swallow(data: bytes) -> Iterable[bytes]:
        return [] if silent.is_set() else [data]

    impatient = WsgConfig(reply_timeout=2.0, move_timeout=6.0, home_timeout=50.0, stale_after=3.0)
    with relayed(swallow, config=impatient) as (gripper, relay, plant):
        gripper.home()
        gripper.move(width=0.020, speed=0.4)
        silent.set()
        with pytest.raises(PeerTimeout, match="PRE_POSITION"):
            gripper.move(width=0.060, speed=0.02)
        assert relay.ids()[-3:] == [Command.PRE_POSITION, Command.STOP, Command.STOP]  # repeated without an answer
        eventually(lambda: plant.gripper_state()[1] == 0.0, "the fingers were not stopped")
        with pytest.raises(PeerTimeout, match="old"):
            gripper.state()


def test_other_device_types_are_refused() -> None:
    def other_type(data: bytes) -> Iterable[bytes]:
        # Device info with type 2 and its checksum.
        return [bytes.fromhex("aaaaaa500a000000020100 04 bec30000") + b"\x00\x00"] if data[3:4] == b"\x50" else [data]

    config = WsgConfig(reply_timeout=20, stale_after=20, crc=False)
    with pytest.raises(PeerError, match="type 2"), relayed(other_type, config=config):
        pass
