"""The conversation with a WSG-50: one thread reads, sorts replies from updates, and callers wait for theirs.

A motion is answered twice, PENDING and then with its result, and periodic updates come in between. Replies go to
whoever waits for that command; updates go to a callback; what nobody waits for (a duplicate) is counted.
"""

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator

from gelflow.clock import Clock
from gelflow.errors import GelflowError, PeerError, PeerRefused, PeerTimeout
from gelflow.real.transport import SHORTEST_WALL_TIMEOUT, Transport
from gelflow.real.wsg.codec import Corrupt, Decoder, Packet, Reply, parse_reply, plausible_reply
from gelflow.real.wsg.constants import STATE_COMMANDS, Command, Status

_log = logging.getLogger(__name__)
_log.addHandler(logging.NullHandler())  # a driver prints nothing unless its program asks for it
_POLL = 0.05  # how long the reader waits for bytes before it looks around [s]
_HALF_FRAME = 0.5  # a frame whose rest does not come in this time is given up [s]; TCP may resend for 0.2 s


class WsgRefused(PeerRefused):
    """The gripper answered with a status other than success; `pending` when it had begun the motion."""

    def __init__(self, text: str, *, status: Status, pending: bool = False) -> None:
        super().__init__(text)
        self.status = status
        self.pending = pending


class WsgLink:
    """Requests and replies over a transport.

    `on_update(reply, stamp)` is called from the reading thread for every update; a GelflowError from it ends the
    link. `corrupt` counts frames with a wrong checksum, `unexpected` replies that nobody waited for.
    """

    def __init__(
        self,
        transport: Transport,
        *,
        clock: Clock,
        on_update: Callable[[Reply, float], None],
        reply_timeout: float,
        command_interval: float,
        crc: bool,
    ) -> None:
        self._transport = transport
        self._clock = clock
        self._on_update = on_update
        self._reply_timeout = reply_timeout
        self._interval = command_interval
        self._crc = crc
        self._decoder = Decoder(plausible=plausible_reply, check_crc=crc)
        self._condition = threading.Condition()
        self._boxes: list[tuple[Command, deque[Reply]]] = []
        self._failure: GelflowError | None = None
        self._dead = False  # the transport is broken; after any other failure a stop can still be sent
        self._pacing = threading.Lock()
        self._writing = threading.Lock()
        self._last_write = -float("inf")
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self.corrupt = 0
        self.unexpected = 0

    @property
    def address(self) -> str:
        return self._transport.address

    @property
    def failure(self) -> GelflowError | None:
        """Why the link ended, None while it lives."""
        return self._failure

    def open(self) -> None:
        """Connect and start to read. Raises PeerError when nobody is there."""
        self._transport.open()
        self._thread = threading.Thread(target=self._read_until_closed, name=f"wsg {self.address}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop reading and close the transport; may be called twice."""
        self._ending.set()
        self._dead = True
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        self._transport.close()
        self._fail(PeerError(f"the link to the gripper at {self.address} is closed"))

    def request(self, frame: Packet, *, urgent: bool = False) -> Reply:
        """Send a command that is answered once; returns its successful reply.

        `urgent` does not keep the pause between commands. Raises PeerTimeout, PeerRefused or PeerError.
        """
        with self._box(Command(frame.id)) as box:
            self._send(frame, urgent=urgent)
            reply = self._take(box, frame, self._reply_timeout)
        if reply.status != Status.SUCCESS:
            text = f"the gripper answered {reply.command.name} with {reply.status.name}"
            raise WsgRefused(text, status=reply.status)
        return reply

    def send(self, frame: Packet) -> None:
        """Send a command at once and wait for no answer. Raises PeerError when the transport is broken."""
        self._write(frame)

    def run(self, frame: Packet, *, timeout: float) -> tuple[Reply, bool]:
        """Send a motion and wait for its result: the final reply, and whether it was pending before.

        Raises PeerTimeout when no first answer comes in the reply time-out or no result in `timeout` [s].
        """
        pending = False
        with self._box(Command(frame.id)) as box:
            self._send(frame, urgent=False)
            deadline = self._clock.now() + timeout
            while True:
                reply = self._take(box, frame, deadline - self._clock.now() if pending else self._reply_timeout)
                if reply.status == Status.CMD_PENDING:
                    pending = True
                elif pending or reply.status != Status.SUCCESS:
                    return reply, pending
                # A success before the motion was pending repeats an earlier command's result.

    def _send(self, frame: Packet, *, urgent: bool) -> None:
        if urgent:
            self.send(frame)
            return
        with self._pacing:
            self._clock.sleep(self._last_write + self._interval - self._clock.now())
            self._write(frame)

    def _write(self, frame: Packet) -> None:
        with self._writing:
            if self._dead:
                raise self._broken()
            try:
                self._transport.write(frame.encode(crc=self._crc))
            except PeerError as error:
                self._dead = True
                self._fail(error)  # a part of the frame may be out: nothing sensible can follow it
                raise
            self._last_write = self._clock.now()

    @contextlib.contextmanager
    def _box(self, command: Command) -> Iterator[deque[Reply]]:
        entry: tuple[Command, deque[Reply]] = (command, deque())
        with self._condition:
            self._boxes.append(entry)
        try:
            yield entry[1]
        finally:
            with self._condition:
                self._boxes = [other for other in self._boxes if other is not entry]

    def _take(self, box: deque[Reply], frame: Packet, timeout: float) -> Reply:
        end = time.monotonic() + max(self._clock.wall(timeout), SHORTEST_WALL_TIMEOUT)
        with self._condition:
            while not box:
                if self._failure is not None:
                    raise self._broken()
                left = end - time.monotonic()
                if left <= 0:
                    raise PeerTimeout(
                        f"the gripper at {self.address} did not answer {Command(frame.id).name} in time: "
                        f"is it on, and not used by another program?"
                    )
                self._condition.wait(left)
            return box.popleft()

    def _broken(self) -> GelflowError:
        assert self._failure is not None
        return type(self._failure)(str(self._failure))  # an exception of its own for every thread that raises it

    def _fail(self, error: GelflowError) -> None:
        with self._condition:
            if self._failure is None:
                self._failure = error
                if not self._ending.is_set():
                    _log.error("the link to the gripper ended: %s", error)
            self._condition.notify_all()

    def _read_until_closed(self) -> None:
        try:
            patience = max(self._clock.wall(_HALF_FRAME), SHORTEST_WALL_TIMEOUT)
            progress = time.monotonic()
            while not self._ending.is_set() and self._failure is None:
                data = self._read()
                stamp = self._clock.now()
                events = self._decoder.feed(data)
                if not events and self._decoder.waiting and time.monotonic() - progress > patience:
                    events = self._decoder.expire()
                    progress = time.monotonic()
                if events or not self._decoder.waiting:
                    progress = time.monotonic()
                for event in events:
                    self._sort(event, stamp)
        except GelflowError as error:
            self._fail(error)
        finally:
            self._fail(PeerError(f"the link to the gripper at {self.address} is no longer read"))

    def _read(self) -> bytes:
        try:
            return self._transport.read(_POLL)
        except GelflowError:
            self._dead = True
            raise

    def _sort(self, event: Packet | Corrupt, stamp: float) -> None:
        if isinstance(event, Corrupt):
            self.corrupt += 1
            _log.error("a frame with id %#04x came with a wrong checksum", event.id)
            return
        reply = parse_reply(event)
        with self._condition:
            boxes = [box for command, box in self._boxes if command == reply.command]
            for box in boxes:
                box.append(reply)
            self._condition.notify_all()
        if reply.command in STATE_COMMANDS and reply.status == Status.SUCCESS:
            self._on_update(reply, stamp)
        elif not boxes:
            self.unexpected += 1
            _log.warning("nobody waited for %s %s", reply.command.name, reply.status.name)
