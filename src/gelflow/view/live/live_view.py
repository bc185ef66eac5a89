"""The run's side of a live page: starts its process and receives the stop button. It imports no viewer."""

import contextlib
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

from gelflow.clock import raise_priority
from gelflow.errors import PeerError, UsageError
from gelflow.helper_process import HelperProcess

_START_LIMIT = 60.0  # for the page to be served [s, wall]
_END_LIMIT = 4.0  # for the page to show the last state [s, wall]


class LiveView:
    """A live page in a process of its own. Use it as a context manager around runs.

    Parameters
    ----------
    host: address to bind to; any other than a loopback address needs the random token in `url`
    port: TCP port; 0 takes a free one
    on_lost: called with one line when the page ends by itself; the run goes on

    Raises UsageError when the page cannot be served, with nothing moved.
    """

    def __init__(self, *, host: str, port: int, on_lost: Callable[[str], None] = lambda line: None) -> None:
        self._settings = {"host": host, "port": port}
        self._on_lost = on_lost
        self._lock = threading.Lock()  # of the following two
        self._stop: Callable[[str], None] | None = None
        self._requested = ""
        self._ending = False
        self._ended = "the command has ended"
        self.url = ""

    def __enter__(self) -> "LiveView":
        self._helper = HelperProcess.start("gelflow.view.live.page_process", self._settings)
        try:
            answer: dict[str, Any] = next(iter(self._helper.messages.wait(_START_LIMIT)), {})
        except TimeoutError as error:
            self._helper.close()
            raise PeerError(f"the page did not start: {error}") from error
        if "url" not in answer:
            reason = answer.get("error") or self._helper.exit_reason()
            self._helper.close()
            raise UsageError(str(reason))
        self.url = str(answer["url"])
        self._thread = threading.Thread(target=self._receive, name="live page", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """Show the last state, then end the page."""
        if error is not None:
            self._ended = str(error) or type(error).__name__
        elif self._requested:
            self._ended = self._requested
        self._ending = True
        self._send({"ended": self._ended})
        self._helper.stop(limit=_END_LIMIT)
        self._thread.join(_END_LIMIT)
        self._helper.close()

    def show(self, session: Path) -> None:
        """Follow another recording, which may not exist yet."""
        with self._lock:
            self._stop = None
        self._send({"session": str(Path(session).resolve())})

    def watch(self, stop: Callable[[str], None]) -> None:
        """Call `stop` with a reason, from another thread, when the stop button is pressed, also if it was before."""
        with self._lock:
            self._stop, requested = stop, self._requested
        if requested:
            stop(requested)

    def _send(self, message: dict[str, Any]) -> None:
        with contextlib.suppress(OSError):  # the page is gone: the run goes on
            self._helper.messages.send(message)

    def _receive(self) -> None:
        raise_priority()
        while True:
            try:
                values = self._helper.messages.wait()
            except (OSError, ValueError):  # closed by this side
                return
            for value in values:
                self._handle(value)
            if self._helper.messages.closed:
                break
        if not self._ending:
            self._on_lost(f"the live page has ended ({self._helper.exit_reason()}); the run goes on without it")

    def _handle(self, value: dict[str, Any]) -> None:
        if "stop" not in value:
            return
        with self._lock:
            self._requested, stop = str(value["stop"]), self._stop
        if stop is not None:
            stop(self._requested)
