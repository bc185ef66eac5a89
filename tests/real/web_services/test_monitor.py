"""Monitor of the controller's state: it approves a state, and every change of it is an error."""

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from gelflow.clock import ScaledClock
from gelflow.errors import PeerError, PeerRefused, PeerTimeout, SafetyError, UsageError
from gelflow.hardware_mocks.web_services.device import MockWebServices
from gelflow.real.web_services import monitor as monitor_module
from gelflow.real.web_services.client import WebServicesClient
from gelflow.real.web_services.monitor import ControllerMonitor

CLOCK = ScaledClock(20.0)  # polls every 25 ms
PATIENT = 10.0  # wall time that only a failing test reaches [s]


@contextmanager
def monitored(stale: float = 1e3) -> Iterator[tuple[MockWebServices, ControllerMonitor]]:
    with MockWebServices() as server, ControllerMonitor(WebServicesClient(server.url), CLOCK, stale=stale) as monitor:
        yield server, monitor


def error_of(call: Callable[[], object]) -> Exception:
    """The first error that repeated calls raise."""
    end = time.monotonic() + PATIENT
    while time.monotonic() < end:
        try:
            call()
        except (PeerError, SafetyError) as error:
            return error
        time.sleep(0.005)
    raise AssertionError("no error")


def test_state_is_read_again_and_again() -> None:
    with monitored() as (server, monitor):
        first = monitor.state()
        assert (first.operating_mode, first.controller_state) == ("auto", "motors on")
        server.opmode = "MANR"
        end = time.monotonic() + PATIENT
        while monitor.state().operating_mode != "manual reduced":
            assert time.monotonic() < end
        assert monitor.state().stamp > first.stamp


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("opmode", "MANF", "operating mode is manual full; it must be auto or manual reduced"),
        ("opmode", "AUTO_CH", "operating mode is change to auto not confirmed"),
        ("ctrlstate", "emergencystop", "the controller reports emergency stop"),
        ("ctrlstate", "motoroff", "the controller reports motors off"),
        ("execution", "stopped", "the RAPID program is stopped"),
    ],
)
def test_only_a_ready_controller_is_approved(name: str, value: str, message: str) -> None:
    with MockWebServices() as server:
        setattr(server, name, value)
        with ControllerMonitor(WebServicesClient(server.url), CLOCK, stale=1e3) as monitor:
            with pytest.raises(SafetyError, match=message) as caught:
                monitor.approve()
            assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("opmode", "MANR", "the operating mode changed from auto to manual reduced"),
        ("opmode", "MANF", "the operating mode changed from auto to manual full"),
        ("ctrlstate", "emergencystop", "the controller state changed from motors on to emergency stop"),
        ("execution", "stopped", "the RAPID program changed from running to stopped"),
    ],
)
def test_change_after_the_approval_is_an_error(name: str, value: str, message: str) -> None:
    with monitored() as (server, monitor):
        monitor.check()
        monitor.approve()
        monitor.check()
        setattr(server, name, value)
        error = error_of(monitor.check)
        assert isinstance(error, SafetyError) and message in str(error)


def test_lost_controller_is_an_error_after_the_limit() -> None:
    with monitored(stale=10.0) as (server, monitor):
        monitor.approve()
        server.broken = b"<html>"
        begun = CLOCK.now()
        error = error_of(monitor.check)
        assert isinstance(error, PeerError) and "expected an answer with opmode" in str(error)
        assert CLOCK.now() - begun > 8.0  # a single failed reading is no error
        server.broken = None
        end = time.monotonic() + PATIENT
        while True:  # the connection is restored
            try:
                monitor.check()
                break
            except PeerError:
                assert time.monotonic() < end
                time.sleep(0.01)


def test_unreachable_controller_cannot_be_opened() -> None:
    with MockWebServices(password="changed") as server, pytest.raises(PeerRefused, match="Default User"):
        ControllerMonitor(WebServicesClient(server.url), CLOCK).open()
    monitor = ControllerMonitor(WebServicesClient("http://127.0.0.1:1"), CLOCK)
    with pytest.raises(UsageError, match="open the monitor"):
        monitor.state()
    monitor.close()


def test_a_failed_opening_ends_its_session() -> None:
    with MockWebServices() as server:
        server.broken = b"<html>"
        with pytest.raises(PeerError, match="expected an answer with opmode"):
            ControllerMonitor(WebServicesClient(server.url), CLOCK).open()
        end = time.monotonic() + PATIENT
        while server.sessions:
            assert time.monotonic() < end
            time.sleep(0.01)


def test_an_answer_that_never_ends_does_not_block_the_opening(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each byte comes within the time-out of the client."""
    monkeypatch.setattr(monitor_module, "_FIRST_READING", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as server:
        ended = threading.Event()

        def drip() -> None:
            link, _ = server.accept()
            with link, contextlib.suppress(OSError):
                link.sendall(b"HTTP/1.1 200 OK\r\nX-Endless: ")
                while not ended.wait(0.05):
                    link.sendall(b"a")

        thread = threading.Thread(target=drip, daemon=True)
        thread.start()
        client = WebServicesClient(f"http://127.0.0.1:{server.getsockname()[1]}", timeout=0.5)
        with pytest.raises(PeerTimeout, match="has not answered completely"):
            ControllerMonitor(client, CLOCK).open()
        ended.set()
        thread.join(PATIENT)


def test_session_is_ended() -> None:
    with MockWebServices() as server:
        with ControllerMonitor(WebServicesClient(server.url), CLOCK) as monitor:
            assert len(server.sessions) == 1
            with pytest.raises(UsageError, match="already open"):
                monitor.open()
        monitor.close()
        end = time.monotonic() + PATIENT
        while server.sessions:
            assert time.monotonic() < end
