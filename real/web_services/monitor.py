"""Polls the state of the controller in a thread, and reports every change during a run."""

import contextlib
import threading
import time
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from gelflow import interrupts
from gelflow.clock import Clock
from gelflow.errors import GelflowError, PeerError, PeerTimeout, SafetyError, UsageError
from gelflow.real.limits import LIMITS
from gelflow.real.web_services.client import ControllerReading, WebServicesClient

PERIOD = 0.5  # between two readings [s, robot time]
_FIRST_READING = 12.0  # longest wait for the first reading [s, wall]
_POLL = 0.05  # between two looks at a deferred signal [s, wall]
_ALLOWED_MODES = ("auto", "manual reduced")


@dataclass(frozen=True)
class ControllerState(ControllerReading):
    """The newest state of the controller."""

    stamp: float  # robot time at which it was asked for [s]


class ControllerMonitor:
    """The state of the controller, at most `stale` [s, robot time] old.

    A thread reads it every 0.5 s, so a change shows after up to a second: this supervises the operator's panel, and is
    no means to stop in time. EGM itself reports motors that are off within 4 ms. Use `with`, or `open` and `close`.
    """

    def __init__(self, client: WebServicesClient, clock: Clock, *, stale: float = LIMITS.controller_age) -> None:
        self._client, self._clock, self._stale = client, clock, stale
        self._state: ControllerState | None = None
        self._approved: ControllerState | None = None
        self._failure: PeerError | None = None
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self._answered = threading.Event()  # the first reading is done
        self._thread: threading.Thread | None = None

    def open(self) -> Self:
        """Start the thread and wait for its first reading.

        Raises PeerError when the controller does not answer, PeerTimeout when it takes longer than 12 s.
        """
        if self._thread is not None:
            raise UsageError("web services: already open")
        self._ending.clear()
        self._answered.clear()
        self._failure = None
        self._thread = threading.Thread(target=self._run, name="web services", daemon=True)
        self._thread.start()
        deadline = time.monotonic() + _FIRST_READING
        # In the thread, since the time-out of the client bounds each wait only, and a slow answer has many of them.
        while not self._answered.wait(_POLL):
            if interrupts.is_pending() or time.monotonic() > deadline:
                self.close()
                raise PeerTimeout(f"web services: {self._client.address} has not answered completely")
        if (failure := self._failure) is not None:
            self.close()
            raise failure
        return self

    def close(self) -> None:
        """Stop reading and end the session; may be called twice."""
        thread, self._thread = self._thread, None
        self._ending.set()
        if thread is not None:
            thread.join(0.5)  # the thread ends by itself after its present request

    def __enter__(self) -> Self:
        return self if self._thread is not None else self.open()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    def state(self) -> ControllerState:
        """The newest state. Raises PeerError of the last reading when it is too old or there is none."""
        with self._lock:
            state, failure = self._state, self._failure
        age = float("inf") if state is None else self._clock.now() - state.stamp
        if state is not None and age <= self._stale:
            return state
        if failure is not None:
            raise type(failure)(*failure.args) from failure
        if state is None:
            raise UsageError("web services: open the monitor first")
        raise PeerTimeout(f"web services: the newest state is {age:.1f} s old, at most {self._stale:g} s is allowed")

    @property
    def operating_mode(self) -> str:
        """The newest operating mode; "unknown" when it is too old."""
        try:
            return self.state().operating_mode
        except PeerError:
            return "unknown"

    def approve(self) -> ControllerState:
        """The newest state, which `check` compares with from now on.

        Raises SafetyError when the arm must not move in it: any mode other than auto and manual reduced, motors that
        are not on, or a program that does not run.
        """
        state = self.state()
        if state.operating_mode not in _ALLOWED_MODES:
            raise SafetyError(f"operating mode is {state.operating_mode}; it must be auto or manual reduced")
        if state.controller_state != "motors on":
            raise SafetyError(f"the controller reports {state.controller_state}; it must be motors on")
        if state.execution != "running":
            raise SafetyError(f"the RAPID program is {state.execution}; start it")
        self._approved = state
        return state

    def check(self) -> None:
        """Raise SafetyError when the state differs from the approved one, PeerError when it is not known."""
        now, before = self.state(), self._approved
        if before is None:
            return
        for name, old, new in (
            ("operating mode", before.operating_mode, now.operating_mode),
            ("controller state", before.controller_state, now.controller_state),
            ("RAPID program", before.execution, now.execution),
        ):
            if new != old:
                raise SafetyError(f"the {name} changed from {old} to {new}; start a new run when it is restored")

    def _run(self) -> None:
        while not self._ending.is_set():
            with contextlib.suppress(GelflowError):  # `state` raises it when no newer reading succeeds
                self._read()
            self._answered.set()
            self._ending.wait(self._clock.wall(PERIOD))
        self._client.logout()  # after a failed first reading too, which may have begun a session

    def _read(self) -> None:
        asked = self._clock.now()
        try:
            reading = self._client.read()
        except PeerError as error:
            with self._lock:
                self._failure = error
            raise
        with self._lock:
            self._state = ControllerState(reading.operating_mode, reading.controller_state, reading.execution, asked)
            self._failure = None
