"""Shared helpers of the WSG-50 driver tests: mock gripper, connected driver, and a relay that corrupts bytes."""

import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress

import pytest

from gelflow.clock import ScaledClock
from gelflow.errors import GelflowError
from gelflow.hardware_mocks.plant import KinematicGripper
from gelflow.hardware_mocks.wsg.device import MockWsgGripper
from gelflow.hardware_mocks.wsg.finger_controller import MockWsgConfig
from gelflow.protocols import GripperState
from gelflow.real.transport import transport_for
from gelflow.real.wsg.config import WsgConfig
from gelflow.real.wsg.driver import WsgGripper

CLOCK = ScaledClock(5.0)


PATIENT = 10.0  # time-out that only a failing test reaches [s, wall]
# Generous time-outs, because a busy test machine may delay the device.
CONFIG = WsgConfig(reply_timeout=20.0, home_timeout=50.0, move_timeout=50.0, stale_after=20.0)


class CommandRecord:
    """Records the commands and states that a recorder receives."""

    def __init__(self) -> None:
        self.commands: list[tuple[str, dict[str, float]]] = []
        self.states: list[GripperState] = []

    def command(self, name: str, values: Mapping[str, float]) -> None:
        self.commands.append((name, dict(values)))

    @property
    def names(self) -> list[str]:
        return [name for name, _ in self.commands]


Corruption = Callable[[bytes], Iterable[bytes]]


class Relay:
    """A TCP relay that forwards bytes to the mock, and the bytes of the mock back through `corrupt`."""

    def __init__(self, target: tuple[str, int], corrupt: Corruption) -> None:
        self.corrupt = corrupt
        self.sent = b""  # bytes sent by the driver
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp:127.0.0.1:{self._listener.getsockname()[1]}"
        self._target = target
        self._links: list[socket.socket] = []
        self._threads = [threading.Thread(target=self._serve, daemon=True)]
        self._threads[0].start()

    def _serve(self) -> None:
        with suppress(OSError):
            client, _ = self._listener.accept()
            device = socket.create_connection(self._target)
            self._links += [client, device]
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            back = threading.Thread(target=self._back, args=(device, client), daemon=True)
            self._threads.append(back)
            back.start()
            while data := client.recv(4096):
                self.sent += data
                device.sendall(data)
            device.shutdown(socket.SHUT_RDWR)  # wakes the thread of the other direction

    def _back(self, device: socket.socket, client: socket.socket) -> None:
        with suppress(OSError):
            while data := device.recv(4096):
                for chunk in self.corrupt(data):
                    client.sendall(chunk)

    def close(self) -> None:
        for link in [self._listener, *self._links]:
            with suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
            link.close()
        for thread in self._threads:
            thread.join(PATIENT)

    def ids(self) -> list[int]:
        """Ids of the commands that the driver sent."""
        return [self.sent[i + 3] for i in range(len(self.sent) - 3) if self.sent[i : i + 3] == b"\xaa\xaa\xaa"]


@contextmanager
def mock(
    *, width: float = 0.050, config: MockWsgConfig | None = None, clock: ScaledClock = CLOCK
) -> Iterator[tuple[MockWsgGripper, KinematicGripper]]:
    plant = KinematicGripper(clock, width=width)
    with MockWsgGripper(plant, clock=clock, config=config, tcp_port=0) as device:
        yield device, plant


@contextmanager
def connected(
    *, config: WsgConfig = CONFIG, device: MockWsgConfig | None = None, width: float = 0.050
) -> Iterator[tuple[WsgGripper, MockWsgGripper, KinematicGripper, CommandRecord]]:
    with mock(config=device, width=width) as (server, plant):
        record = CommandRecord()
        transport = transport_for(server.addresses[0], clock=CLOCK)
        with WsgGripper(
            transport, clock=CLOCK, config=config, on_command=record.command, on_measurement=record.states.append
        ) as gripper:
            yield gripper, server, plant, record


@contextmanager
def relayed(corrupt: Corruption, *, config: WsgConfig = CONFIG) -> Iterator[tuple[WsgGripper, Relay, KinematicGripper]]:
    with mock() as (server, plant):
        relay = Relay(server.tcp_address, corrupt)
        try:
            with WsgGripper(transport_for(relay.address, clock=CLOCK), clock=CLOCK, config=config) as gripper:
                yield gripper, relay, plant
        finally:
            relay.close()


def unmodified(data: bytes) -> Iterable[bytes]:
    return [data]


def eventually(reached: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + PATIENT
    while not reached():
        assert time.monotonic() < end, what
        time.sleep(0.005)


def wait_for_error(gripper: WsgGripper) -> None:
    """Call `state` until it raises: the reader thread detects a lost link with a delay."""
    end = time.monotonic() + PATIENT
    while time.monotonic() < end:
        gripper.state()
        time.sleep(0.005)
    pytest.fail("the driver did not detect the lost link")


def in_thread(call: Callable[[], object]) -> tuple[threading.Thread, list[GelflowError]]:
    errors: list[GelflowError] = []

    def run() -> None:
        try:
            call()
        except GelflowError as error:
            errors.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread, errors
