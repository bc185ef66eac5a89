"""The process of a live page: follows the recording of a run, and passes the stop button to the process of the run.

It reads the file that the recorder writes, so the run never waits for the page. Messages from the run: `session`, the
recording to follow; `ended`, the last state in words. Messages to the run: `url` or `error` at the start; `stop`.
"""

import os
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gelflow.errors import GelflowError, PeerError, UsageError
from gelflow.helper_process import Messages, connect_to_parent
from gelflow.view.page import Page
from gelflow.view.session.recorded_session import RecordedSession
from gelflow.view.session.session_page import SessionPage

_TICK = 0.04  # [s]
_NICENESS = 5  # of the thread that draws: the run comes first
# viser has no setting for the size of a button; the stop button is the only red one.
_LARGE_BUTTON = '<style>button[style*="-red-"] {height: 7rem; font-size: 1.6rem; font-weight: 700}</style>'
_LAST_STATE = 0.5  # time for browsers to receive the last state [s]


class LivePage:
    """The page: a stop button, and the session that is being recorded."""

    def __init__(self, page: Page, messages: Messages) -> None:
        self._page, self._messages = page, messages
        self._stop = page.gui.add_button("STOP THE ARM", color="red", hint="in addition to the robot's own stop")
        self._stop.on_click(self._request_stop)
        page.gui.add_html(_LARGE_BUTTON)
        self._state = page.gui.add_markdown("waiting for the recording of the run")
        self._path: Path | None = None
        self._session: RecordedSession | None = None
        self._shown: SessionPage | None = None

    def run(self) -> None:
        """Serve the page until the run closes the link."""
        while not self._messages.closed:
            begun = time.monotonic()
            for message in self._messages.read():
                self._handle(message)
            if self._shown is None and self._path is not None:
                self._open(self._path)
            if self._shown is not None:
                self._shown.update()
            time.sleep(max(0.0, begun + _TICK - time.monotonic()))

    def close(self) -> None:
        """Remove the session from the page."""
        if self._shown is not None:
            self._shown.remove()
            self._shown = None
        if self._session is not None:
            self._session.reader.close()
            self._session = None

    def _request_stop(self, _: Any) -> None:
        # In a thread of viser: it does not wait for the drawing.
        self._messages.send({"stop": "the stop button of the page was pressed"})
        self._state.content = f"**stop requested at {time.strftime('%H:%M:%S')}**"

    def _handle(self, message: dict[str, Any]) -> None:
        if "session" in message:
            self.close()
            self._path = Path(message["session"])
            self._state.content = f"recording {self._path.name}"
        if "ended" in message:
            self._stop.disabled = True
            self._state.content = f"**the run has ended: {message['ended']}**{self._view_command()}"
            if self._shown is not None:
                self._shown.show_end()
            time.sleep(_LAST_STATE)

    def _view_command(self) -> str:
        return "" if self._path is None else f"  \nlook at it again: `gelflow view {shlex.quote(str(self._path))}`"

    def _open(self, path: Path) -> None:
        """Show a recording once its first records are written."""
        try:
            self._session = RecordedSession(path, live=True)
        except (UsageError, PeerError):
            return
        self._shown = SessionPage([self._session], page=self._page)


def main(arguments: Sequence[str]) -> int:
    """Entry point of the process."""
    settings, messages, _ = connect_to_parent(arguments)
    try:
        page = Page(host=settings["host"], port=settings["port"])
    except GelflowError as error:
        messages.send({"error": str(error)})
        return 1
    messages.send({"url": page.url})
    live = LivePage(page, messages)
    os.setpriority(os.PRIO_PROCESS, 0, _NICENESS)  # of this thread alone; those of the page's server exist already
    try:
        live.run()
    finally:
        live.close()
        page.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
