"""Mock WSG-50 on the wire: one device behind a pty, a TCP port, or both."""

import contextlib
import math
import os
import selectors
import socket
import threading
import tty
from typing import Any

from gelflow.clock import Clock, ScaledClock
from gelflow.errors import UsageError
from gelflow.hardware_mocks.message_faults import MessageFault, MessageFaults
from gelflow.hardware_mocks.plant import GripperPlant
from gelflow.hardware_mocks.wsg.finger_controller import MockWsgConfig
from gelflow.hardware_mocks.wsg.protocol import WsgDevice, WsgSession
from gelflow.time_sync import GRIPPER, MAX_LEAD

_TICK = 0.005  # period of the device [s]; half the shortest period of updates
_SHORTEST_WAIT = 0.0005  # lower bound of the wait for any clock factor [s, wall]
_READ_SIZE = 4096  # bytes
_BACKLOG = 65536  # a TCP client with more unread bytes is disconnected


class _Link:
    """Faults of one connection, in both directions. Used by the device's thread; faults begin and end in others."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._faults = {direction: MessageFaults(ordered=True) for direction in ("in", "out")}

    def begin(self, number: int, kind: str, direction: str, values: dict[str, Any]) -> None:
        with self._lock:
            for name, faults in self._faults.items():
                if direction in (name, "both"):
                    faults.begin(number, MessageFault(kind, **values))

    def end(self, number: int) -> None:
        with self._lock:
            for faults in self._faults.values():
                faults.end(number)

    def clear(self) -> None:
        """Drop the bytes on the way in both directions: the connection has ended."""
        with self._lock:
            for faults in self._faults.values():
                faults.clear()

    def receive(self, data: bytes, now: float) -> None:
        with self._lock:
            self._faults["in"].put(data, now)

    def deliver(self, session: WsgSession, now: float) -> None:
        """Give received bytes that are due to `session`."""
        with self._lock:
            portions = self._faults["in"].take(now)
        for portion in portions:
            session.receive(portion)

    def send(self, packets: list[bytes], now: float) -> list[bytes]:
        """The packets that reach the client now, instead of `packets`."""
        with self._lock:
            for packet in packets:
                self._faults["out"].put(packet, now)
            return self._faults["out"].take(now)


class MockWsgGripper:
    """Serves one mock gripper. Nothing is opened before `open` (or `with`).

    `serial` opens a pty at `serial_path`; `tcp_port` opens a TCP port on `host` (0: any free port) at `tcp_address`.
    One TCP client at a time; further clients are rejected.
    """

    def __init__(
        self,
        plant: GripperPlant,
        *,
        clock: Clock,
        config: MockWsgConfig | None = None,
        serial: bool = True,
        tcp_port: int | None = None,
        host: str = "127.0.0.1",
    ) -> None:
        if not serial and tcp_port is None:
            raise UsageError("the mock gripper needs a pty (serial=True), a tcp_port, or both")
        self._device = WsgDevice(plant, clock=clock, config=config)
        self._clock = clock
        self._serial = serial
        self._wanted = None if tcp_port is None else (host, tcp_port)
        self._selector: selectors.BaseSelector | None = None
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None
        self._client_session: WsgSession | None = None
        self._unsent = b""
        self._master = self._slave = -1
        self._line_session: WsgSession | None = None
        self._line, self._network = _Link(), _Link()
        self._refused: set[int] = set()  # faults that keep clients from connecting
        self._thread: threading.Thread | None = None
        self._ending = threading.Event()
        self.serial_path = ""
        self.tcp_address = ("", 0)

    def __enter__(self) -> "MockWsgGripper":
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self) -> None:
        """Open the pty and the port and serve them in a thread. Raises UsageError when the port is in use."""
        if self._thread is not None:
            raise UsageError("the mock gripper is already open")
        self._selector = selectors.DefaultSelector()
        try:
            if self._wanted is not None:
                self._listen(self._wanted)
            if self._serial:
                self._open_line()
        except BaseException:
            self._close_files()
            raise
        self._ending.clear()
        self._thread = threading.Thread(target=self._serve, name="mock wsg", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Close everything; may be called twice."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._close_files()

    def lose_part(self) -> None:
        """Inject a fault: the device reports that the held part is lost."""
        with self._device.lock:
            self._device.fingers.lose_part()

    def raise_fast_stop(self) -> None:
        """Inject a fault: FAST STOP."""
        self._device.stop(fast=True)

    def begin_fault(self, number: int, kind: str, direction: str, values: dict[str, Any]) -> None:
        """Begin a fault: freeze (state values repeat), disconnect, stall (no answer) or one of the messages.

        `direction` is "out" (replies), "in" (commands) or "both". A disconnected pty passes no bytes.
        """
        if kind == "freeze":
            self._device.freeze(number)
            return
        if kind == "disconnect":
            self._refused.add(number)
        cut = kind in ("disconnect", "stall")
        for link in (self._line, self._network):
            link.begin(number, "drop" if cut else kind, "both" if cut else direction, {} if cut else values)

    def end_fault(self, number: int) -> None:
        """End the fault with this number."""
        self._refused.discard(number)
        self._device.unfreeze(number)
        for link in (self._line, self._network):
            link.end(number)

    @property
    def addresses(self) -> tuple[str, ...]:
        """Addresses for a driver: `serial:PATH`, `tcp:HOST:PORT`, or both."""
        line = (f"serial:{self.serial_path}",) if self._serial else ()
        port = ("tcp:{}:{}".format(*self.tcp_address),) if self._wanted else ()
        return line + port

    @property
    def fast_stopped(self) -> bool:
        """Whether the device is in FAST STOP."""
        return self._device.fingers.fast_stopped

    def _listen(self, address: tuple[str, int]) -> None:
        assert self._selector is not None
        try:
            self._listener = socket.create_server(address)
        except (OSError, OverflowError) as error:
            raise UsageError(f"the mock gripper cannot listen on {address[0]}:{address[1]} ({error})") from None
        self._listener.setblocking(False)
        self.tcp_address = self._listener.getsockname()[:2]
        self._selector.register(self._listener, selectors.EVENT_READ, self._accept)

    def _open_line(self) -> None:
        assert self._selector is not None
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)  # kept open, so that the pty persists between clients
        os.set_blocking(self._master, False)
        self.serial_path = os.ttyname(self._slave)
        self._line_session = WsgSession(self._device)
        self._selector.register(self._master, selectors.EVENT_READ, self._read_line)

    def _close_files(self) -> None:
        for open_socket in (self._client, self._listener):
            if open_socket is not None:
                open_socket.close()
        for descriptor in (self._master, self._slave):
            if descriptor >= 0:
                os.close(descriptor)
        if self._selector is not None:
            self._selector.close()
        self._client = self._listener = self._selector = None
        self._client_session = self._line_session = None
        self._master = self._slave = -1

    def _serve(self) -> None:
        assert self._selector is not None
        wait = max(self._clock.wall(_TICK), _SHORTEST_WAIT)
        while not self._ending.wait(0):
            self._allow(self._clock.now() + _TICK + MAX_LEAD)  # robot time waits for late answers
            for key, _ in self._selector.select(wait):
                key.data()
            self._device.poll()
            now = self._clock.now()
            if self._line_session is not None:
                self._line.deliver(self._line_session, now)
                for packet in self._line.send(self._line_session.tick(), now):
                    # A serial line has no flow control: unread bytes are lost.
                    with contextlib.suppress(BlockingIOError):
                        os.write(self._master, packet)
            if self._refused and self._client is not None:
                self._drop_client()
            if self._client_session is not None:
                self._network.deliver(self._client_session, now)
                self._unsent += b"".join(self._network.send(self._client_session.tick(), now))
                self._flush()

        self._allow(math.inf)

    def _allow(self, until: float) -> None:
        if isinstance(self._clock, ScaledClock):
            self._clock.grant(GRIPPER, until)

    def _read_line(self) -> None:
        assert self._line_session is not None
        with contextlib.suppress(BlockingIOError):
            now = self._clock.now()
            self._line.receive(os.read(self._master, _READ_SIZE), now)
            self._line.deliver(self._line_session, now)

    def _accept(self) -> None:
        assert self._listener is not None and self._selector is not None
        try:
            client, _ = self._listener.accept()
        except OSError:
            return  # the client disconnected before it was accepted
        self._read_client()  # the disconnect of the previous client may still be unread
        if self._client is not None or self._refused:
            client.close()
            return
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client, self._client_session, self._unsent = client, WsgSession(self._device), b""
        self._selector.register(client, selectors.EVENT_READ, self._read_client)

    def _read_client(self) -> None:
        while self._client is not None and self._client_session is not None:
            try:
                data = self._client.recv(_READ_SIZE)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if data:
                now = self._clock.now()
                self._network.receive(data, now)
                self._network.deliver(self._client_session, now)
            else:
                self._drop_client()

    def _flush(self) -> None:
        assert self._client is not None
        if not self._unsent:
            return
        try:
            sent = self._client.send(self._unsent)
            self._unsent = self._unsent[sent:]
        except BlockingIOError:
            pass
        except OSError:
            self._drop_client()
            return
        if len(self._unsent) > _BACKLOG:
            self._drop_client()

    def _drop_client(self) -> None:
        assert self._client is not None and self._client_session is not None and self._selector is not None
        self._selector.unregister(self._client)
        self._client.close()
        self._client_session.lost()
        self._network.clear()
        self._client = self._client_session = None
