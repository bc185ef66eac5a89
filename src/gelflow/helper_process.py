"""Helper processes for work that must not wait for the parent's threads, linked to the parent by a socket pair.

A helper is a fresh interpreter that runs one module: it imports nothing of the parent's `__main__` and does not share
its global interpreter lock. It ends when the parent's end of the socket pair closes.
"""

import contextlib
import json
import multiprocessing
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import IO, Any

from gelflow.interrupts import SIGNALS

_WORKER_PERIOD = 0.2  # between two checks of a worker whether it has to end [s, wall]
_EXIT_LIMIT = 1.0  # time from the closed link to the helper's exit [s, wall]


class Messages:
    """JSON values, one per line, over a connected non-blocking socket."""

    def __init__(self, link: socket.socket) -> None:
        link.setblocking(False)
        self._link = link
        self._buffer = b""
        self._sending = threading.Lock()
        self.closed = False  # the peer closed its end

    def fileno(self) -> int:
        """The socket's file descriptor, for `select`."""
        return self._link.fileno()

    def send(self, value: Any, *, limit: float = 1.0) -> None:
        """Send one value; safe from any thread. Waits at most `limit` [s, wall].

        Raises TimeoutError, after which the link is unusable, or another OSError when the peer is gone.
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
        """All values that have arrived, without waiting; sets `closed` when the peer has closed its end."""
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

    def wait(self, limit: float | None = None) -> list[Any]:
        """At least one value, or an empty list when the peer closed its end.

        Raises TimeoutError when nothing arrives within `limit` [s, wall]; None waits without limit.
        """
        end = None if limit is None else time.monotonic() + limit
        while not (values := self.read()) and not self.closed:
            left = None if end is None else end - time.monotonic()
            if (left is not None and left <= 0) or not select.select((self._link,), (), (), left)[0]:
                raise TimeoutError(f"the other process sent nothing for {limit} s")
        return values

    def close(self) -> None:
        """Close this end; a thread that waits for a message stops waiting."""
        with contextlib.suppress(OSError):
            self._link.shutdown(socket.SHUT_RDWR)  # `close` alone does not end a `select` of another thread
        self._link.close()


class HelperProcess:
    """The parent's handle of a helper process."""

    def __init__(self, process: "subprocess.Popen[bytes]", messages: Messages, errors: IO[bytes]) -> None:
        self._process = process
        self._errors = errors  # the helper's standard error
        self.messages = messages

    @classmethod
    def start(cls, module: str, settings: dict[str, Any], *, descriptors: Sequence[int] = ()) -> "HelperProcess":
        """Run `python -m module`, which obtains `settings` and the open file descriptors from `connect_to_parent`.

        Modules of the working folder are not importable in it, as in the `gelflow` command.
        """
        ours, theirs = socket.socketpair()
        errors = tempfile.TemporaryFile()  # noqa: SIM115  (closed in close)
        numbers = (theirs.fileno(), *descriptors)
        # The helper imports this gelflow, wherever the parent found it.
        paths = (str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", ""))
        try:
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", module, json.dumps(settings), *map(str, numbers)],
                pass_fds=numbers,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=errors,
                # One thread: a BLAS thread pool would compete with the parent for the cores.
                env=os.environ
                | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
                | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            )
        except OSError:
            ours.close()
            errors.close()
            raise
        finally:
            theirs.close()
        return cls(process, Messages(ours), errors)

    @property
    def pid(self) -> int:
        """Process identifier."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether the process has not ended yet."""
        return self._process.poll() is None

    def exit_reason(self) -> str:
        """Exit status and last line of standard error of a helper that has closed its link."""
        try:
            code = self._process.wait(_EXIT_LIMIT)
        except subprocess.TimeoutExpired:
            return "it closed its link and hangs"
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").split("\n")
        return f"exit status {code}" + "".join(f": {line.strip()}" for line in lines[-2:-1])

    def kill(self) -> None:
        """End the process at once (SIGKILL)."""
        self._process.kill()

    def stop(self, *, limit: float = _EXIT_LIMIT) -> int:
        """Close the link, which makes the helper end, and return its exit status.

        A helper that does not end within `limit` [s, wall] is killed.
        """
        self.messages.close()
        try:
            return self._process.wait(limit)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()

    def close(self) -> None:
        """Stop the helper and release its files."""
        self.stop()
        self._errors.close()


def memory_file(size: int) -> int:
    """Descriptor of a new file of `size` bytes that both processes map; it has no name and ends with its last user.

    In memory where the system allows it: on a disk, a write to a mapped file waits while the disk is busy.
    """
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("gelflow")
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.ftruncate(descriptor, size)
    return descriptor


@contextlib.contextmanager
def worker_pool(count: int) -> Iterator[ProcessPoolExecutor]:
    """`count` fresh interpreters for computations; they end with their parent, also if it is killed.

    An exception in the body, such as that of Ctrl-C, ends the running computations at once, and no other one starts.
    """
    context = multiprocessing.get_context("spawn")
    ending = context.Event()
    with ProcessPoolExecutor(count, mp_context=context, initializer=_end_with_parent, initargs=(ending,)) as pool:
        try:
            yield pool
        except BaseException:
            ending.set()
            pool.shutdown(cancel_futures=True)
            raise


def _end_with_parent(ending: Event) -> None:
    """Let this worker end when its parent ends or sets `ending`; signals of the terminal are left to the parent."""
    parent = multiprocessing.parent_process()
    assert parent is not None, "for worker processes"
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)

    def wait() -> None:
        while not ending.wait(_WORKER_PERIOD) and parent.is_alive():
            pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def connect_to_parent(arguments: Sequence[str]) -> tuple[dict[str, Any], Messages, list[int]]:
    """The helper's side: its settings, the link to its parent, and the file descriptors that it inherited.

    Ignores Ctrl-C and the signals that end a terminal or a service, which reach every process: the parent decides when
    its helpers end.
    """
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    link, *descriptors = map(int, arguments[1:])
    return json.loads(arguments[0]), Messages(socket.socket(fileno=link)), descriptors
