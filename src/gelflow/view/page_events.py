"""Calls from the threads of a page to the thread that draws it."""

import queue
from collections.abc import Callable
from typing import Any


class PageEvents:
    """Functions that the page's threads leave to one other thread."""

    def __init__(self) -> None:
        self._waiting: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()

    def post(self, function: Callable[..., None], *values: Any) -> None:
        """Let the next `handle` call a function; for any thread."""
        self._waiting.put(lambda: function(*values))

    def handle(self) -> bool:
        """Call the functions that wait, in order; whether there were any."""
        found = False
        while True:
            try:
                event = self._waiting.get_nowait()
            except queue.Empty:
                return found
            found = True
            event()
