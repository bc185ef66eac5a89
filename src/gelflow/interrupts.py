"""Signals that end a run: raised in the main thread, deferred while devices are opened and closed."""

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

from gelflow.errors import GelflowError

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


class Interrupted(KeyboardInterrupt):
    """The first of `SIGNALS`, raised in the main thread; later ones are ignored, so that the shutdown completes."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


class _State:
    """Present state of the main thread."""

    depth = 0  # number of blocks that defer signals
    pending = 0  # deferred signal, 0: none
    raised = False  # since `interruptible` began


def defer() -> None:
    """Defer signals until `resume`. No effect outside `interruptible` or in another thread."""
    if threading.current_thread() is threading.main_thread():
        _State.depth += 1


def resume() -> None:
    """End `defer`. Raises Interrupted when a signal has arrived in between."""
    if threading.current_thread() is threading.main_thread():
        _State.depth = max(0, _State.depth - 1)
        if _State.depth == 0 and _State.pending and not _State.raised:
            _State.raised = True
            raise Interrupted(_State.pending)


def is_pending() -> bool:
    """Whether `resume` will raise a deferred signal, so that a long wait in this thread should end."""
    return threading.current_thread() is threading.main_thread() and bool(_State.pending) and not _State.raised


@contextlib.contextmanager
def deferred() -> Iterator[None]:
    """Defer signals in this block, or in the function that this decorates; see `defer` and `resume`."""
    defer()
    try:
        yield
    finally:
        resume()


@contextlib.contextmanager
def interruptible() -> Iterator[list[Callable[[], None]]]:
    """In this block the first signal of `SIGNALS` raises Interrupted in the main thread, which must run it.

    Yields a list for functions that another thread calls at once on a signal, because the main thread notices it only
    when its present computation ends. Signals that were ignored when the block began stay ignored.
    """
    at_once: list[Callable[[], None]] = []
    readable, writable = os.pipe()
    os.set_blocking(writable, False)
    _State.depth, _State.pending, _State.raised = 0, 0, False

    def interrupt(number: int, frame: FrameType | None) -> None:
        if _State.raised or _State.pending:
            return
        if _State.depth:
            _State.pending = number
            return
        _State.raised = True
        raise Interrupted(number)

    def watch() -> None:
        while received := os.read(readable, 1):
            for action in at_once if received[0] in SIGNALS else ():
                with contextlib.suppress(GelflowError):
                    action()

    watcher = threading.Thread(target=watch, name="signals", daemon=True)
    watcher.start()
    before = {number: signal.getsignal(number) for number in SIGNALS}
    wakeup = signal.set_wakeup_fd(writable, warn_on_full_buffer=False)
    try:
        for number, handler in before.items():
            if handler is not signal.SIG_IGN:
                signal.signal(number, interrupt)
        yield at_once
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(wakeup)
        os.close(writable)
        watcher.join(1.0)
        os.close(readable)
