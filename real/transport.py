"""Byte transports for stream devices: serial lines (or ptys) and TCP connections.

Each operation has a time-out in robot time. A transport never reconnects by itself, because a command sent before a
break must not be repeated: the caller decides. Every packet is sent in one write.
"""

import contextlib
import errno
import os
import socket
import time
from collections.abc import Callable
from typing import Protocol

import serial

from gelflow.clock import Clock
from gelflow.errors import PeerError, PeerTimeout, UsageError
from gelflow.real.addresses import is_host

# Lower bound of the time limits of connecting and writing [s, wall]: with a fast clock, a peer on the same machine
# still needs time from the scheduler.
SHORTEST_WALL_TIMEOUT = 0.5
_READ_SIZE = 4096  # bytes
_CLOSE_TIMEOUT = 0.2  # a peer that does not close its side is waited for no longer [s, wall]


class Transport(Protocol):
    """A stream of bytes to one device."""

    @property
    def address(self) -> str:
        """Address of the peer, for messages."""
        ...

    def open(self) -> None:
        """Connect. Raises PeerTimeout or PeerError when the peer does not answer."""
        ...

    def read(self, timeout: float) -> bytes:
        """Bytes received within `timeout` [s, robot time], empty if none. Raises PeerError on a broken connection."""
        ...

    def write(self, data: bytes) -> None:
        """Send all of `data` in one write. Raises PeerTimeout when the peer accepts no data, PeerError on a break."""
        ...

    def close(self) -> None:
        """Close; may be called twice, raises nothing."""
        ...


class TcpTransport:
    """A TCP connection."""

    def __init__(
        self, host: str, port: int, *, clock: Clock, connect_timeout: float = 2.0, write_timeout: float = 0.5
    ) -> None:
        if not is_host(host) or not 0 < port < 65536:
            raise UsageError(f"a TCP address needs a valid host and a port of 1 to 65535, got {host!r} and {port}")
        self._peer = host, port
        self._clock = clock
        self._connect_timeout = connect_timeout
        self._write_timeout = write_timeout
        self._socket: socket.socket | None = None

    @property
    def address(self) -> str:
        return f"tcp:{self._peer[0]}:{self._peer[1]}"

    def open(self) -> None:
        if self._socket is not None:
            raise UsageError(f"{self.address} is already open")
        try:
            connection = socket.create_connection(self._peer, _wall(self._clock, self._connect_timeout))
        except TimeoutError:
            raise PeerTimeout(
                f"no answer from {self.address} within {self._connect_timeout} s: is it on, is the address right?"
            ) from None
        except OSError as error:
            raise PeerError(
                f"no connection to {self.address} ({error.strerror or error}): is it on, is the address right?"
            ) from None
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket = connection

    def read(self, timeout: float) -> bytes:
        connection = self._connected()
        try:
            connection.settimeout(max(self._clock.wall(timeout), 1e-3))
            data = connection.recv(_READ_SIZE)
        except TimeoutError:
            return b""
        except OSError as error:
            raise PeerError(f"the connection to {self.address} broke ({error.strerror or error})") from None
        if not data:
            raise PeerError(f"{self.address} closed the connection")
        return data

    def write(self, data: bytes) -> None:
        connection = self._connected()
        # Reader and writer threads share the socket's time-out: poll instead of setting it.
        try:
            accepted = _send_all(
                lambda rest: connection.send(rest, socket.MSG_DONTWAIT), data, _wall(self._clock, self._write_timeout)
            )
        except OSError as error:
            raise PeerError(f"the connection to {self.address} broke ({error.strerror or error})") from None
        if not accepted:
            raise PeerTimeout(f"{self.address} accepted no data for {self._write_timeout} s")

    def close(self) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.shutdown(socket.SHUT_WR)
                self._discard_until_closed(self._socket)
            self._socket.close()
            self._socket = None

    @staticmethod
    def _discard_until_closed(connection: socket.socket) -> None:
        """Read until the peer closes too.

        Unread bytes at `close` would reset the connection, and the peer could lose the last command.
        """
        deadline = time.monotonic() + _CLOSE_TIMEOUT
        while (left := deadline - time.monotonic()) > 0:
            connection.settimeout(left)
            if not connection.recv(_READ_SIZE):
                return

    def _connected(self) -> socket.socket:
        if self._socket is None:
            raise UsageError(f"{self.address} is not open")
        return self._socket


class SerialTransport:
    """A serial line (8N1) or a pty."""

    def __init__(self, path: str, *, clock: Clock, baudrate: int = 115200, write_timeout: float = 0.5) -> None:
        if not path or baudrate <= 0:
            raise UsageError(f"a serial line needs a path and a baud rate above 0, got {path!r} and {baudrate}")
        self._path = path
        self._clock = clock
        self._baudrate = baudrate
        self._write_timeout = write_timeout
        self._serial: serial.Serial | None = None

    @property
    def address(self) -> str:
        return f"serial:{self._path}"

    def open(self) -> None:
        if self._serial is not None:
            raise UsageError(f"{self.address} is already open")
        try:
            # Opening also discards buffered bytes of an earlier session.
            self._serial = serial.Serial(
                self._path,
                self._baudrate,
                timeout=0.05,
                exclusive=True,  # two programs on one line read each other's replies
            )
        except (serial.SerialException, OSError, ValueError) as error:
            raise PeerError(f"no connection to {self._path} ({_serial_reason(error)})") from None

    def read(self, timeout: float) -> bytes:
        line = self._connected()
        try:
            wall = max(self._clock.wall(timeout), 1e-3)
            if line.timeout != wall:  # setting it reconfigures the whole port
                line.timeout = wall
            return bytes(line.read(1)) + bytes(line.read(line.in_waiting))
        except (serial.SerialException, OSError, TypeError) as error:
            raise PeerError(f"the line {self._path} broke ({_serial_reason(error)})") from None

    def write(self, data: bytes) -> None:
        line = self._connected()
        # Not by pyserial: after a write it waits for the next one, and reports data that were accepted as refused when
        # this program was stopped meanwhile.
        try:
            descriptor = line.fileno()
            accepted = _send_all(lambda rest: os.write(descriptor, rest), data, _wall(self._clock, self._write_timeout))
        except (serial.SerialException, OSError, TypeError) as error:
            raise PeerError(f"the line {self._path} broke ({_serial_reason(error)})") from None
        if not accepted:
            raise PeerTimeout(f"{self._path} accepted no data for {self._write_timeout} s")

    def close(self) -> None:
        if self._serial is not None:
            with contextlib.suppress(serial.SerialException, OSError):
                self._serial.close()
            self._serial = None

    def _connected(self) -> serial.Serial:
        if self._serial is None:
            raise UsageError(f"{self._path} is not open")
        return self._serial


def transport_for(address: str, *, clock: Clock, baudrate: int = 115200) -> Transport:
    """The transport for an address: `tcp:HOST:PORT` or `serial:PATH` such as serial:/dev/ttyUSB0.

    Raises UsageError when the address is neither.
    """
    kind, _, rest = address.partition(":")
    if kind == "serial" and rest:
        return SerialTransport(rest, clock=clock, baudrate=baudrate)
    host, _, port = rest.rpartition(":")
    if kind == "tcp" and host and port.isascii() and port.isdigit():
        return TcpTransport(host.removeprefix("[").removesuffix("]"), int(port), clock=clock)
    raise UsageError(f"address {address!r} is neither tcp:HOST:PORT nor serial:PATH such as serial:/dev/ttyUSB0")


def _wall(clock: Clock, seconds: float) -> float:
    return max(clock.wall(seconds), SHORTEST_WALL_TIMEOUT)


def _send_all(send: Callable[[memoryview], int], data: bytes, limit: float) -> bool:
    """Pass all of `data` to `send`, which returns the number of bytes that it accepted and does not wait.

    False when the peer has not accepted all within `limit` [s, wall]. The limit is compared before an attempt, which
    follows also after it: time in which this program was stopped is no refusal.
    """
    deadline = time.monotonic() + limit
    rest = memoryview(data)
    while rest:
        late = time.monotonic() > deadline
        try:
            sent = send(rest)
        except (BlockingIOError, InterruptedError, TimeoutError):
            sent = 0
        rest = rest[sent:]
        if rest and late:
            return False
        if not sent:
            time.sleep(1e-3)
    return True


def _serial_reason(error: Exception) -> str:
    """The cause in one line, without pyserial's nesting."""
    number = getattr(error, "errno", None)
    if number == errno.ENOENT:
        return "no such device: is it plugged in?"
    if number == errno.EACCES:
        return "permission denied: is this user in the group of serial devices (dialout)?"
    if number in (errno.EAGAIN, errno.EBUSY):
        return "another program has it open"
    return str(error).splitlines()[0] if str(error) else type(error).__name__
