"""Byte transports: closing without a reset when received bytes are unread, and time limits of writing."""

import os
import socket
import threading
import time
import tty
from collections.abc import Iterator

import pytest

from gelflow.clock import ScaledClock
from gelflow.errors import PeerTimeout, UsageError
from gelflow.real.transport import SerialTransport, transport_for


def test_last_command_arrives_when_the_peer_is_still_sending() -> None:
    ended: list[object] = []
    sent = threading.Event()

    def serve(listener: socket.socket) -> None:
        peer, _ = listener.accept()
        with peer:
            peer.sendall(b"update")
            sent.set()
            try:
                ended.append(peer.recv(100))
                peer.sendall(b"update")
                ended.append(peer.recv(100))
            except OSError as error:
                ended.append(error)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve, args=(listener,), daemon=True)
        thread.start()
        transport = transport_for(f"tcp:127.0.0.1:{listener.getsockname()[1]}", clock=ScaledClock(1.0))
        transport.open()
        assert sent.wait(10.0)
        transport.write(b"disconnect")
        transport.close()
        thread.join(10.0)
    assert ended == [b"disconnect", b""]


@pytest.mark.parametrize("host", ["192.168.1..20", ".local", "a" * 64, "a\0b", ""])
def test_a_name_that_cannot_be_looked_up_is_refused(host: str) -> None:
    with pytest.raises(UsageError, match=r"tcp:HOST:PORT|needs a valid host"):
        transport_for(f"tcp:{host}:1000", clock=ScaledClock(1.0))


def test_close_does_not_wait_for_a_peer_that_does_not_close() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        transport = transport_for(f"tcp:127.0.0.1:{listener.getsockname()[1]}", clock=ScaledClock(1.0))
        transport.open()
        started = time.monotonic()
        transport.close()
        assert time.monotonic() - started < 5.0


@pytest.fixture
def line() -> Iterator[tuple[int, SerialTransport]]:
    """The far end of a serial line, and a transport on it."""
    master, slave = os.openpty()
    tty.setraw(slave)
    transport = SerialTransport(os.ttyname(slave), clock=ScaledClock(1.0), write_timeout=0.2)
    transport.open()
    yield master, transport
    transport.close()
    os.close(master)
    os.close(slave)


def test_stop_of_the_program_during_a_write_is_no_refusal(
    line: tuple[int, SerialTransport], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The data were accepted: a command that is reported as refused could be sent twice."""
    master, transport = line
    write = os.write

    def stopped_afterwards(descriptor: int, data: memoryview) -> int:
        sent = write(descriptor, data)
        time.sleep(0.6)  # longer than the write may take
        return sent

    monkeypatch.setattr(os, "write", stopped_afterwards)
    transport.write(b"open")
    assert os.read(master, 100) == b"open"


def test_line_that_accepts_nothing_is_a_timeout(line: tuple[int, SerialTransport]) -> None:
    _, transport = line
    with pytest.raises(PeerTimeout, match=r"accepted no data for 0\.2 s"):
        transport.write(bytes(1 << 20))
