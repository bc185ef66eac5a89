"""Byte transports: a TCP connection is closed without a reset, even when received bytes are unread."""

import socket
import threading
import time

from gelflow.clock import ScaledClock
from gelflow.real.transport import transport_for


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


def test_close_does_not_wait_for_a_peer_that_does_not_close() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        transport = transport_for(f"tcp:127.0.0.1:{listener.getsockname()[1]}", clock=ScaledClock(1.0))
        transport.open()
        started = time.monotonic()
        transport.close()
        assert time.monotonic() - started < 5.0
