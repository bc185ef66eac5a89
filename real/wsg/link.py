"""Requests and replies of a WSG-50: a reader thread separates replies from updates, callers wait for their reply.

A motion is answered twice, first PENDING and then with its result, and periodic updates arrive in between. A reply
goes to the caller that waits for its command, an update to a callback; an unexpected reply (a duplicate) is counted.
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
from gelflow.real.wsg.constants import RESULTS, STATE_COMMANDS, Command, Status

_log = logging.getLogger(__name__)
_log.addHandler(logging.NullHandler())  # silent unless the program configures logging
_POLL = 0.05  # time-out of one read, after which the reader thread checks whether it should end [s]
_PACKET_TIMEOUT = 0.5  # an incomplete packet is abandoned after this time [s]; TCP may resend for 0.2 s


class WsgRefused(PeerRefused):
    """The gripper answered with a status other than success, or the motion was not sent after a stop.

    `pending`: it had started the motion.
    """

    def __init__(self, text: str, *, status: Status, pending: bool = False) -> None:
        super().__init__(text)
        self.status = status
        self.pending = pending


class WsgLink:
    """Requests and replies over a transport.

    `on_update(reply, stamp)` is called from the reader thread for every update; a GelflowError from it ends the
    link. `corrupt` counts packets with a wrong checksum, `unexpected` replies without a waiting caller.
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
        self._inboxes: list[tuple[Command, deque[Reply]]] = []
        self._failure: GelflowError | None = None
        self._broken = False  # the transport failed; after any other failure a stop can still be sent
        self._pacing = threading.Lock()
        self._writing = threading.Lock()
        self._last_write = -float("inf")
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self.corrupt = 0
        self.stops = 0  # that were sent, and calls of `refuse_prepared`

    @property
    def address(self) -> str:
        return self._transport.address

    @property
    def failure(self) -> GelflowError | None:
        """The reason why the link ended; None while it is open."""
        return self._failure

    def open(self) -> None:
        """Connect and start the reader thread. Raises PeerError when the connection fails."""
        self._transport.open()
        self._thread = threading.Thread(target=self._read_until_closed, name=f"wsg {self.address}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop reading and close the transport; may be called twice."""
        self._ending.set()
        self._broken = True
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        self._transport.close()
        self._fail(PeerError(f"the link to the gripper at {self.address} is closed"))

    def request(self, packet: Packet, *, urgent: bool = False) -> Reply:
        """Send a command that is not a motion; returns its successful reply.

        `urgent` skips the pause between commands. Raises PeerTimeout, PeerRefused or PeerError.
        """
        with self._inbox(Command(packet.id)) as inbox:
            self.send(packet, urgent=urgent)
            reply = self._take(inbox, packet, self._reply_timeout)
            if reply.status == Status.CMD_PENDING:  # some firmware first acknowledges a stop
                reply = self._take(inbox, packet, self._reply_timeout)
        if reply.status != Status.SUCCESS:
            text = f"the gripper answered {reply.command.name} with {reply.status.name}"
            raise WsgRefused(text, status=reply.status)
        return reply

    def send(
        self, packet: Packet, *, urgent: bool = False, stops: int | None = None, inbox: deque[Reply] | None = None
    ) -> None:
        """Send a command without waiting for a reply, after the pause between commands unless it is `urgent`.

        Earlier replies are removed from `inbox` in the moment of sending. Raises PeerError when the transport is
        broken, and WsgRefused when there were more than `stops` stops.
        """
        if urgent:
            self._write(packet)
            return
        with self._pacing:
            self._clock.sleep(self._last_write + self._interval - self._clock.now())
            self._write(packet, stops, inbox)

    def refuse_prepared(self) -> None:
        """Refuse motions that are prepared and not sent yet, as after a stop. Sends nothing."""
        with self._writing:
            self.stops += 1

    def run(self, packet: Packet, *, timeout: float, stops: int) -> tuple[Reply, bool]:
        """Send a motion and wait for its result; returns the final reply and whether the motion had started.

        `stops` is the number of stops when the motion was prepared. Raises WsgRefused when another one came since,
        PeerTimeout without a first reply within the reply time-out or a result within `timeout` [s].
        """
        pending = False
        with self._inbox(Command(packet.id)) as inbox:
            self.send(packet, stops=stops, inbox=inbox)
            sent = self._clock.now()
            while True:
                passed = self._clock.now() - sent
                reply = self._take(inbox, packet, (timeout if pending else self._reply_timeout) - passed)
                if reply.status == Status.CMD_PENDING:
                    if pending and self._clock.now() > sent + timeout:
                        raise self._no_answer(packet)
                    pending = True
                elif pending or reply.status not in RESULTS:
                    return reply, pending
                # A result before the motion is pending is that of an earlier command, or the first reply was lost.

    def _write(self, packet: Packet, stops: int | None = None, inbox: deque[Reply] | None = None) -> None:
        with self._writing:
            if self._broken:
                raise self._failure_copy()
            if packet.id in (Command.STOP, Command.FAST_STOP):
                self.stops += 1
            elif stops is not None and stops != self.stops:
                text = f"the gripper was stopped before {Command(packet.id).name} was sent"
                raise WsgRefused(text, status=Status.CMD_ABORTED)
            if inbox is not None:
                with self._condition:
                    inbox.clear()
            try:
                self._transport.write(packet.encode(crc=self._crc))
            except PeerError as error:
                self._broken = True
                self._fail(error)  # a part of the packet may be out, and nothing can follow it
                raise
            self._last_write = self._clock.now()

    @contextlib.contextmanager
    def _inbox(self, command: Command) -> Iterator[deque[Reply]]:
        entry: tuple[Command, deque[Reply]] = (command, deque())
        with self._condition:
            self._inboxes.append(entry)
        try:
            yield entry[1]
        finally:
            with self._condition:
                self._inboxes = [other for other in self._inboxes if other is not entry]

    def _take(self, inbox: deque[Reply], packet: Packet, timeout: float) -> Reply:
        end = time.monotonic() + max(self._clock.wall(timeout), SHORTEST_WALL_TIMEOUT)
        with self._condition:
            while not inbox:
                if self._failure is not None:
                    raise self._failure_copy()
                left = end - time.monotonic()
                if left <= 0:
                    raise self._no_answer(packet)
                self._condition.wait(left)
            return inbox.popleft()

    def _no_answer(self, packet: Packet) -> PeerTimeout:
        return PeerTimeout(
            f"the gripper at {self.address} did not answer {Command(packet.id).name} in time: "
            f"is it on, and not used by another program?"
        )

    def _failure_copy(self) -> GelflowError:
        if self._failure is None:  # the link broke just now, in another thread
            return PeerError(f"the link to the gripper at {self.address} is broken")
        return type(self._failure)(str(self._failure))  # a separate exception for each thread that raises it

    def _fail(self, error: GelflowError) -> None:
        with self._condition:
            if self._failure is None:
                self._failure = error
                if not self._ending.is_set():
                    _log.error("the link to the gripper ended: %s", error)
            self._condition.notify_all()

    def _read_until_closed(self) -> None:
        try:
            patience = max(self._clock.wall(_PACKET_TIMEOUT), SHORTEST_WALL_TIMEOUT)
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
                    self._dispatch(event, stamp)
        except GelflowError as error:
            self._fail(error)
        finally:
            self._fail(PeerError(f"the link to the gripper at {self.address} is no longer read"))

    def _read(self) -> bytes:
        try:
            return self._transport.read(_POLL)
        except GelflowError:
            self._broken = True
            raise

    def _dispatch(self, event: Packet | Corrupt, stamp: float) -> None:
        if isinstance(event, Corrupt):
            self.corrupt += 1
            _log.error("received a packet with id %#04x and a wrong checksum", event.id)
            return
        reply = parse_reply(event)
        with self._condition:
            inboxes = [inbox for command, inbox in self._inboxes if command == reply.command]
            for inbox in inboxes:
                inbox.append(reply)
            self._condition.notify_all()
        if reply.command in STATE_COMMANDS and reply.status == Status.SUCCESS:
            self._on_update(reply, stamp)
        elif not inboxes:
            _log.warning("unexpected reply %s %s", reply.command.name, reply.status.name)
