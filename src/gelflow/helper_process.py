"""A helper process of ours for what must not wait for anything else, linked to its parent by a socket pair.

It is a fresh interpreter that runs one module (nothing of the parent's `__main__` is imported again, and neither its
threads nor its global interpreter lock stand in the way). When its parent is gone, however it went, it ends.
"""

import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

_FAREWELL = 1.0  # how long a child may take to end, once it was told [s, wall]


class Messages:
    """JSON values, one a line, over a connected socket that does not block."""

    def __init__(self, link: socket.socket) -> None:
        link.setblocking(False)
        self._link = link
        self._buffer = b""
        self._sending = threading.Lock()
        self.closed = False  # the other side is gone

    def fileno(self) -> int:
        return self._link.fileno()

    def send(self, value: Any, *, limit: float = 1.0) -> None:
        """Send one value, from any thread; waits up to `limit` [s, wall].

        Raises TimeoutError, after which the link is of no more use, or another OSError when nobody is there.
        """
        data = memoryview(json.dumps(value).encode() + b"\n")
        end = time.monotonic() + limit
        with self._sending:
            while data:
                try:
                    data = data[self._link.send(data) :]
                except BlockingIOError:
                    wait = end - time.monotonic()
                    if wait <= 0 or not select.select((), (self._link,), (), wait)[1]:
                        raise TimeoutError(f"the other process read nothing for {limit} s") from None

    def read(self) -> list[Any]:
        """All values that have arrived, without waiting; sets `closed`."""
        while not self.closed:
            try:
                data = self._link.recv(65536)
            except BlockingIOError:
                break
            except ConnectionError:
                data = b""
            self.closed = not data
            self._buffer += data
        *lines, self._buffer = self._buffer.split(b"\n")
        return [json.loads(line) for line in lines]

    def close(self) -> None:
        self._link.close()


class Child:
    """The parent's handle."""

    def __init__(self, process: "subprocess.Popen[bytes]", messages: Messages, complaints: IO[bytes]) -> None:
        self._process = process
        self._complaints = complaints
        self.messages = messages

    @classmethod
    def start(cls, module: str, settings: dict[str, Any], *, descriptors: Sequence[int] = ()) -> "Child":
        """Run `python -m module`, which calls `adopted` and finds there `settings` and the open file descriptors."""
        ours, theirs = socket.socketpair()
        complaints = tempfile.TemporaryFile()  # noqa: SIM115  (closed in close)
        numbers = (theirs.fileno(), *descriptors)
        # The child must find the same gelflow, however this process found it.
        paths = (str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", ""))
        try:
            process = subprocess.Popen(
                [sys.executable, "-m", module, json.dumps(settings), *map(str, numbers)],
                pass_fds=numbers,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=complaints,
                # One thread: a pool for matrix products would only compete with whom it serves.
                env=os.environ
                | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
                | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            )
        except OSError:
            ours.close()
            complaints.close()
            raise
        finally:
            theirs.close()
        return cls(process, Messages(ours), complaints)

    @property
    def pid(self) -> int:
        return self._process.pid

    def last_words(self) -> str:
        """How a child that is gone ended: its exit status and the last line of its complaints."""
        try:
            code = self._process.wait(_FAREWELL)
        except subprocess.TimeoutExpired:
            return "it closed its link and hangs"
        self._complaints.seek(0)
        lines = self._complaints.read().decode(errors="replace").split("\n")
        return f"exit status {code}" + "".join(f": {line.strip()}" for line in lines[-2:-1])

    def kill(self) -> None:
        self._process.kill()

    def close(self) -> None:
        """Close the link, which tells the child to end; one that does not is killed."""
        self.messages.close()
        try:
            self._process.wait(_FAREWELL)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._complaints.close()


def adopted(arguments: Sequence[str]) -> tuple[dict[str, Any], Messages, list[int]]:
    """The child's side: its settings, the link to its parent, and the file descriptors it was given.

    Ctrl-C reaches every process of the terminal; what it means is for the parent to say, so it is ignored here.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    link, *descriptors = map(int, arguments[1:])
    return json.loads(arguments[0]), Messages(socket.socket(fileno=link)), descriptors
