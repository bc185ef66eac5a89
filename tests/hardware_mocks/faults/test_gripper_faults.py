"""Faults of the mock gripper on its pty and on TCP, as an independent client sees them."""

import os
import select
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from tests.hardware_mocks.wsg.harness import checksum

from gelflow.clock import ScaledClock
from gelflow.hardware_mocks.plant import KinematicGripper
from gelflow.hardware_mocks.wsg.device import MockWsgGripper

CLOCK = ScaledClock(1.0)
WIDTH_EVERY_20_MS = bytes.fromhex("aaaaaa430300011400368d")
WIDTH_ONCE = 0x43
PREAMBLE = b"\xaa\xaa\xaa"


class Client:
    """Reads what the device sends, without interpreting it."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self.reads: list[tuple[float, bytes]] = []

    def read(self, seconds: float) -> bytes:
        """All bytes within a time; an empty read marks a closed connection."""
        end, data = time.monotonic() + seconds, b""
        while (left := end - time.monotonic()) > 0:
            if select.select([self.descriptor], [], [], left)[0]:
                got = os.read(self.descriptor, 4096)
                self.reads.append((time.monotonic(), got))
                if not got:
                    break
                data += got
        return data


@contextmanager
def updating(wire: str) -> Iterator[tuple[Client, MockWsgGripper]]:
    """A client that receives the width every 20 ms."""
    with MockWsgGripper(KinematicGripper(CLOCK, width=0.05), clock=CLOCK, tcp_port=0) as gripper:
        if wire == "tcp":
            with socket.create_connection(gripper.tcp_address) as link:
                client = Client(link.fileno())
                os.write(client.descriptor, WIDTH_EVERY_20_MS)
                assert packets(client.read(0.3)) > 4
                yield client, gripper
        else:
            descriptor = os.open(gripper.serial_path, os.O_RDWR | os.O_NOCTTY)
            try:
                client = Client(descriptor)
                os.write(descriptor, WIDTH_EVERY_20_MS)
                assert packets(client.read(0.3)) > 4
                yield client, gripper
            finally:
                os.close(descriptor)


def packets(data: bytes) -> int:
    """Number of whole and valid packets with the width of 50 mm."""
    whole = PREAMBLE + struct.pack("<BHHf", 0x43, 6, 0, 50.0)
    return data.count(whole + struct.pack("<H", checksum(whole)))


def during(wire: str, kind: str, seconds: float = 0.5, direction: str = "out", **values: Any) -> tuple[bytes, Client]:
    with updating(wire) as (client, gripper):
        gripper.begin_fault(2, kind, direction, values)
        client.read(0.05)
        client.reads.clear()
        return client.read(seconds), client


@pytest.mark.parametrize("wire", ["tcp", "pty"])
def test_dropped_packets_are_missing(wire: str) -> None:
    data, _ = during(wire, "drop", share=0.5, seed=1)
    assert 4 < packets(data) < 22


@pytest.mark.parametrize("wire", ["tcp", "pty"])
def test_duplicated_packets_arrive_twice(wire: str) -> None:
    data, _ = during(wire, "duplicate", share=1.0, seed=1)
    assert packets(data) > 35


@pytest.mark.parametrize("wire", ["tcp", "pty"])
def test_corrupt_packets_have_a_wrong_checksum(wire: str) -> None:
    data, _ = during(wire, "corrupt", share=1.0, count=2, seed=1)
    assert len(data) > 200 and packets(data) == 0


@pytest.mark.parametrize("wire", ["tcp", "pty"])
def test_split_packets_arrive_in_two_portions(wire: str) -> None:
    data, client = during(wire, "split", share=1.0, delay=0.008, seed=1)
    assert packets(data) > 10
    assert sum(packets(portion) == 0 for _, portion in client.reads) > 15


@pytest.mark.parametrize("wire", ["tcp", "pty"])
def test_garbage_stands_before_the_packets(wire: str) -> None:
    data, _ = during(wire, "garbage", share=1.0, count=50, seed=1)
    assert packets(data) > 10 and len(data) > 55 * packets(data)


@pytest.mark.parametrize("wire", ["tcp", "pty"])
def test_delayed_packets_come_late_and_in_order(wire: str) -> None:
    with updating(wire) as (client, gripper):
        gripper.begin_fault(2, "delay", "out", {"delay": 0.4, "share": 1.0, "seed": 1})
        client.read(0.03)
        assert packets(client.read(0.3)) == 0
        assert packets(client.read(0.4)) > 5


@pytest.mark.parametrize("wire", ["tcp", "pty"])
def test_stalled_gripper_answers_nothing_and_keeps_the_connection(wire: str) -> None:
    with updating(wire) as (client, gripper):
        gripper.begin_fault(2, "stall", "both", {})
        client.read(0.05)
        client.reads.clear()
        assert client.read(0.3) == b"" and not client.reads
        gripper.end_fault(2)
        assert packets(client.read(0.3)) > 4


def test_disconnected_gripper_closes_tcp_and_refuses_clients() -> None:
    with updating("tcp") as (client, gripper):
        gripper.begin_fault(2, "disconnect", "both", {})
        client.read(1.0)
        assert client.reads[-1][1] == b""
        with socket.create_connection(gripper.tcp_address) as refused:
            assert Client(refused.fileno()).read(1.0) == b""
        assert gripper.fast_stopped  # an unannounced end of the connection
        gripper.end_fault(2)
        with socket.create_connection(gripper.tcp_address) as link:
            os.write(link.fileno(), WIDTH_EVERY_20_MS)
            assert packets(Client(link.fileno()).read(0.3)) > 4


def test_disconnected_gripper_is_silent_on_its_pty() -> None:
    with updating("pty") as (client, gripper):
        gripper.begin_fault(2, "disconnect", "both", {})
        client.read(0.05)
        assert client.read(0.3) == b""
        gripper.end_fault(2)
        assert packets(client.read(0.3)) > 4


def test_frozen_gripper_repeats_its_state_while_it_moves() -> None:
    with updating("tcp") as (client, gripper):
        gripper.begin_fault(2, "freeze", "both", {})
        home = PREAMBLE + struct.pack("<BHB", 0x20, 1, 1)
        os.write(client.descriptor, home + struct.pack("<H", checksum(home)))
        received, end = b"", time.monotonic() + 30
        while packets(received) <= 20 and time.monotonic() < end:
            received += client.read(0.1)
        assert packets(received) > 20
        gripper.end_fault(2)
        client.read(0.05)
        assert packets(client.read(0.3)) == 0


def test_dropped_commands_are_not_answered() -> None:
    with MockWsgGripper(KinematicGripper(CLOCK), clock=CLOCK, tcp_port=0) as gripper:
        gripper.begin_fault(2, "drop", "in", {"share": 1.0, "seed": 1})
        with socket.create_connection(gripper.tcp_address) as link:
            os.write(link.fileno(), WIDTH_EVERY_20_MS)
            client = Client(link.fileno())
            assert client.read(0.3) == b""
            gripper.end_fault(2)
            os.write(link.fileno(), WIDTH_EVERY_20_MS)
            assert packets(client.read(0.3)) > 4


def test_delayed_commands_of_a_client_end_with_its_connection() -> None:
    def echo(text: bytes) -> bytes:
        whole = PREAMBLE + struct.pack("<BH", 0x06, len(text)) + text
        return whole + struct.pack("<H", checksum(whole))

    with MockWsgGripper(KinematicGripper(CLOCK), clock=CLOCK, tcp_port=0) as gripper:
        gripper.begin_fault(2, "delay", "in", {"delay": 0.3, "share": 1.0, "seed": 1})
        with socket.create_connection(gripper.tcp_address) as first:
            first.sendall(echo(b"first"))
        with socket.create_connection(gripper.tcp_address, 20.0) as second:
            second.sendall(echo(b"second"))
            received = b""
            while b"second" not in received:
                received += (data := second.recv(4096))
                assert data
        assert b"first" not in received
