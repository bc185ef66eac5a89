"""Questions at the terminal that do not block: the caller's check runs while the program waits for an answer."""

import os
import select
import sys
import termios
from collections.abc import Callable

from rich.console import Console

from gelflow.errors import UsageError

_PERIOD = 0.02  # of the check [s]


def read_line(console: Console, text: str, *, check: Callable[[], object] = lambda: None) -> str:
    """Show `text` and return the line that is typed after it. Calls `check` every 20 ms, and raises what it raises.

    Keys that were typed at a terminal before the question are discarded. Raises UsageError when standard input is
    closed.
    """
    console.print(f"{text} ", style="bold", end="")
    console.file.flush()
    descriptor = _standard_input()
    if os.isatty(descriptor):
        termios.tcflush(descriptor, termios.TCIFLUSH)
    line = b""
    while not line.endswith(b"\n"):
        check()
        if select.select((descriptor,), (), (), _PERIOD)[0]:
            # One byte: what follows the line belongs to the next question.
            character = os.read(descriptor, 1)
            if not character:
                raise _closed()
            line += character
    check()
    return line.decode(errors="replace").strip()


def confirmed(console: Console, text: str, *, check: Callable[[], object] = lambda: None) -> bool:
    """Ask a question; True for the answer "y" or "yes"."""
    return read_line(console, f"{text} [y/N]", check=check).lower() in ("y", "yes")


def _standard_input() -> int:
    try:
        descriptor = sys.stdin.fileno()
        os.fstat(descriptor)
    except (AttributeError, OSError, ValueError):
        raise _closed() from None
    return descriptor


def _closed() -> UsageError:
    return UsageError("standard input is closed, and the question above was not answered; run it in a terminal")
