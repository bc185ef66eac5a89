"""Robot Web Services over HTTP: login, sessions, states, and servers that answer something else."""

import json
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gelflow.errors import PeerError, PeerRefused, PeerTimeout, UsageError
from gelflow.hardware_mocks.web_services.device import MAX_SESSIONS, MockWebServices
from gelflow.real.web_services.client import WebServicesClient, parse_state


def test_states_are_read_with_one_session() -> None:
    with MockWebServices() as server:
        client = WebServicesClient(server.url)
        for _ in range(5):
            assert str(client.read()) == "mode auto, motors on, program running"
        assert len(server.sessions) == 1 and server.requests == 15
        server.opmode, server.ctrlstate, server.execution = "MANF", "guardstop", "stopped"
        reading = client.read()
        assert (reading.operating_mode, reading.controller_state) == ("manual full", "guard stop")
        assert reading.execution == "stopped"
        server.opmode, server.ctrlstate = "NEW_MODE", "new_state"  # of a later version of the controller
        assert (client.read().operating_mode, client.read().controller_state) == ("NEW_MODE", "new_state")
        client.logout()
        assert server.sessions == set()


def test_wrong_password_is_refused() -> None:
    with MockWebServices(password="changed") as server:
        with pytest.raises(PeerRefused, match=r"refuses the user 'Default User'.*401") as caught:
            WebServicesClient(server.url).read()
        assert "\n" not in str(caught.value) and server.requests == 0 and server.sessions == set()


def test_too_many_sessions_are_reported() -> None:
    with MockWebServices() as server:
        server.sessions = {f"old{number}" for number in range(MAX_SESSIONS)}
        with pytest.raises(PeerRefused, match=r"503 .*too many sessions"):
            WebServicesClient(server.url).read()


def test_late_answer_is_a_timeout() -> None:
    with MockWebServices() as server:
        server.latency = 1.0
        with pytest.raises(PeerTimeout, match=r"no answer from http://127\.0\.0\.1"):
            WebServicesClient(server.url, timeout=0.1).read()


def test_unreachable_address_is_reported() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(PeerError, match=r"cannot reach http://127\.0\.0\.1:") as caught:
        WebServicesClient(f"http://127.0.0.1:{port}").read()
    assert "\n" not in str(caught.value)


@contextmanager
def raw_server(answer: bytes) -> Iterator[str]:
    """A server that sends these bytes to every client and closes the connection."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            try:
                while True:
                    link, _ = listener.accept()
                    with link:
                        link.recv(4096)
                        link.sendall(answer)
            except OSError:
                return

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        listener.shutdown(socket.SHUT_RDWR)
        thread.join(2)


@pytest.mark.parametrize(
    "answer",
    [
        b"",
        b"SSH-2.0-OpenSSH\r\n",
        b"HTTP/1.1 200 OK\r\nContent-Length: 900\r\n\r\n{",
        b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\n{}",
        b"HTTP/1.1 200 OK\r\n\r\n<html>router</html>",
        b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n",
        b'HTTP/1.1 401 No\r\nWWW-Authenticate: Basic realm="x"\r\nContent-Length: 0\r\n\r\n',
        b"HTTP/1.1 401 No\r\nContent-Length: 0\r\n\r\n",
        b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
    ],
)
def test_other_servers_are_reported_in_one_line(answer: bytes) -> None:
    with raw_server(answer) as url, pytest.raises(PeerError, match="web services: ") as caught:
        WebServicesClient(url, timeout=1.0).read()
    assert "\n" not in str(caught.value)


@given(
    st.binary(max_size=80)
    | st.recursive(st.text(max_size=9) | st.none(), st.lists).map(lambda x: json.dumps(x).encode())
)
def test_any_other_data_is_an_error(data: bytes) -> None:
    with pytest.raises(PeerError, match="expected an answer with opmode"):
        parse_state(data, "opmode")


@pytest.mark.parametrize("value", [3, "", "x" * 41, "AUTO\n", None, ["AUTO"]])
def test_invalid_values_are_errors(value: object) -> None:
    with pytest.raises(PeerError, match="expected an answer with opmode"):
        parse_state(json.dumps({"_embedded": {"_state": [{"opmode": value}]}}).encode(), "opmode")


@pytest.mark.parametrize(
    "address", ["192.168.125.1", "https://a", "http://", "http://a/rw", "http://u:p@a", "http://a:x", "http://a..b"]
)
def test_invalid_addresses_are_refused(address: str) -> None:
    with pytest.raises(UsageError, match="web services"):
        WebServicesClient(address)
