"""Driver of the Weiss WSG-50 gripper over its binary protocol, on a serial line or TCP.

Every motion is checked before a byte of it is sent, waits for its result, and is followed by a stop of the fingers
when it fails. FAST STOP and other faults forbid motion until an operator calls `acknowledge_fault`.
This is not a safety-rated function.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Mapping

from gelflow import interrupts
from gelflow.clock import Clock
from gelflow.errors import GelflowError, PeerError, PeerRefused, PeerTimeout, SafetyError, UsageError
from gelflow.protocols import GripperState
from gelflow.real.transport import SHORTEST_WALL_TIMEOUT, Transport
from gelflow.real.wsg import codec
from gelflow.real.wsg.checks import (
    check_closes,
    check_duration,
    check_limits,
    check_opens,
    check_ready,
    fingers_move,
    holds_part,
    may_hold_part,
)
from gelflow.real.wsg.codec import Packet, Reply
from gelflow.real.wsg.config import WsgConfig, WsgLimits, narrowed
from gelflow.real.wsg.constants import HOME_OUTWARDS, STATE_COMMANDS, Command, Status, UpdateMode, meaning
from gelflow.real.wsg.link import WsgLink, WsgRefused
from gelflow.real.wsg.state import StateAssembler

_log = logging.getLogger(__name__)
_log.addHandler(logging.NullHandler())  # silent unless the program configures logging
_WSG_50 = 1  # device type
_FORCE_TOLERANCE = 0.5  # between the requested and the confirmed force limit [N]

OnCommand = Callable[[str, Mapping[str, float]], None]
OnMeasurement = Callable[[GripperState], None]


class WsgGripper:
    """A WSG-50 as a `gelflow.protocols.Gripper`. No I/O before `connect` (or `with`).

    `on_command(name, values)` is called with SI values before a command is sent; if it raises, the command is not
    sent (a stop is sent first). `on_measurement(state)` is called from the reader thread whenever all five state
    values are new; a GelflowError from it ends the link.
    """

    def __init__(
        self,
        transport: Transport,
        *,
        clock: Clock,
        config: WsgConfig | None = None,
        on_command: OnCommand | None = None,
        on_measurement: OnMeasurement | None = None,
    ) -> None:
        self._transport = transport
        self._clock = clock
        self._config = config or WsgConfig()
        self._on_command = on_command
        self._on_measurement = on_measurement
        self._limits = self._config.limits
        self._link: WsgLink | None = None
        self._changed = threading.Condition()
        self._values = StateAssembler()
        self._acknowledged = 0  # packets with a wrong checksum that an operator has acknowledged
        self._moving = threading.Lock()
        self._grasped = False
        self._stop_lost = False  # the last stop was not confirmed
        self._forbidden = ""  # the reason of `forbid_motion`

    def __enter__(self) -> "WsgGripper":
        self.connect()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        self.close(reason="done" if kind is None else f"{kind.__name__}: {error}")

    # Connection

    def connect(self) -> None:
        """Open the transport, check that a WSG-50 answers, start its updates. Nothing moves or is acknowledged.

        Raises PeerError (PeerTimeout, PeerRefused) when no WSG-50 answers, UsageError when already connected.
        """
        if self._link is not None:
            raise UsageError("the gripper is already connected")
        config = self._config
        self._values = StateAssembler()
        self._acknowledged = 0
        self._grasped, self._stop_lost, self._forbidden = False, False, ""
        self._link = link = WsgLink(
            self._transport,
            clock=self._clock,
            on_update=self._take_update,
            reply_timeout=config.reply_timeout,
            command_interval=config.command_interval,
            crc=config.crc,
        )
        try:
            link.open()
            kind, _, firmware, serial = link.request(Packet(Command.DEVICE_INFO)).values()
            if kind != _WSG_50:
                raise PeerError(f"{link.address} is a device of type {kind}, expected {_WSG_50} (WSG-50)")
            self._limits = narrowed(config.limits, link.request(Packet(Command.LIMITS)).values())
            for command in STATE_COMMANDS:
                link.request(codec.request_updates(command, UpdateMode.PERIODIC, config.update_period))
            self._await(lambda: self._values.complete, "send its state")
        except BaseException:
            with contextlib.suppress(GelflowError):
                link.send(Packet(Command.DISCONNECT))  # an unannounced close raises FAST STOP
            link.close()
            self._link = None
            raise
        self._acknowledged = link.corrupt  # bytes left on the line from an earlier session are no fault of this one
        _log.info("gripper %s at %s, firmware %#06x", serial, link.address, int(firmware))

    @interrupts.deferred()  # without the announcement, the device raises FAST STOP
    def close(self, *, reason: str = "closed by the program") -> None:
        """Stop the fingers, announce the disconnect, close. May be called twice; errors are logged, not raised.

        While a part is held and nothing moves, no stop is sent, because a stop ends the device's grip. A stop that was
        not confirmed is repeated.
        """
        link, self._link = self._link, None
        if link is None:
            return
        _log.info("disconnecting from the gripper at %s: %s", link.address, reason)
        with self._changed:
            state = self._values.state(corrupt=False) if self._values.complete else None
        held = state is not None and self._holds(state) and not fingers_move(state) and not self._stop_lost
        try:
            if (self._moving.locked() or not held) and not self._config.dry_run:
                self._stop_twice(link)
            try:
                link.request(Packet(Command.DISCONNECT))
                self._record("disconnect", {})
            except GelflowError as error:
                _log.error("disconnect from the gripper: %s", error)
        finally:
            link.close()

    # State

    @property
    def limits(self) -> WsgLimits:
        """The configured limits; after `connect` also narrowed by those of the device."""
        return self._limits

    def state(self) -> GripperState:
        """The newest measured state.

        Raises PeerTimeout when it is older than `stale_after`, PeerError when the link is lost.
        """
        link = self._connected()
        if link.failure is not None:
            raise PeerError(str(link.failure))
        with self._changed:
            state = self._values.state(corrupt=link.corrupt > self._acknowledged)
        age = self._clock.now() - state.stamp
        if age > max(self._config.stale_after, SHORTEST_WALL_TIMEOUT / self._clock.wall(1.0)):
            raise PeerTimeout(f"the gripper's state is {age:.2f} s old, expected at most {self._config.stale_after} s")
        return state

    # Motion

    def home(self, *, part_removed: bool = False) -> None:
        """Reference the fingers outwards (inwards would press the gels together). The driver never homes by itself.

        Raises SafetyError while a part may be held, unless an operator has checked it: `part_removed=True`.
        """
        state = self._ready("home", referenced=False)
        if not part_removed and may_hold_part(state, grasped=self._grasped):
            raise SafetyError(
                f"home refused: a part may be held ({state.grasp}, {state.force:.1f} N); release it, "
                f"or let an operator check the fingers and pass part_removed=True"
            )
        self._move("home", {"direction": HOME_OUTWARDS}, codec.home(HOME_OUTWARDS), self._config.home_timeout)
        self._settle(lambda s: s.referenced, "referenced")
        self._grasped = False

    def move(self, *, width: float, speed: float) -> None:
        """Move the empty fingers to `width` [m] at `speed` [m/s]; returns when they have arrived.

        They close with the smallest force limit. Raises SafetyError outside the limits or while a part may be held,
        UsageError when it takes longer than the time-out, PeerRefused when the fingers are blocked, PeerTimeout and
        PeerError as every command.
        """
        state = self._ready("move")
        check_limits(self._limits, width=width, speed=speed)
        if self._holds(state):
            raise SafetyError("move refused: a part is held; release it instead")
        if may_hold_part(state, grasped=False):
            raise SafetyError(
                f"move refused: a part may be held ({state.grasp}, {state.force:.1f} N); release it instead"
            )
        check_duration(state, width, speed, self._config.move_timeout)
        packet = codec.pre_position(width, speed)
        force = self._limits.force[0] if width < state.width else None  # a hand may be between the fingers
        self._move("move", {"width": width, "speed": speed}, packet, self._config.move_timeout, force=force)
        self._settle(lambda s: s.grasp != "positioning", "done positioning")
        self._grasped = False

    def grasp(self, *, width: float, speed: float, force: float) -> None:
        """Close on a part; returns when the device holds it.

        `width` [m] is the expected width of the part: the device moves there and continues through its clamping
        travel (set on the device) until `force` [N] is reached. Contact before that travel is AXIS_BLOCKED, no
        contact within it is CMD_FAILED; both raise PeerRefused. Raises SafetyError outside the limits, when a part is
        already held, or when `width` is above the present opening (the device would open), UsageError when it takes
        longer than the time-out, PeerTimeout and PeerError as every command.
        """
        state = self._ready("grasp")
        check_limits(self._limits, width=width, speed=speed, force=force)
        if self._holds(state):
            raise SafetyError("grasp refused: a part is already held; release it first")
        check_closes(state, width)
        check_duration(state, width, speed, self._config.move_timeout)
        before = self._grasped
        try:
            values = {"width": width, "speed": speed, "force": force}
            self._move("grasp", values, codec.grasp(width, speed), self._config.move_timeout, force=force)
        except WsgRefused as error:
            # Only a definite "no part" rules out a part between the fingers.
            if error.status == Status.CMD_FAILED or not error.pending:
                self._grasped = before and error.status != Status.CMD_FAILED
            raise
        self._settle(lambda s: s.grasp == "holding", "holding")

    def release(self, *, width: float, speed: float) -> None:
        """Open to `width` [m] at `speed` [m/s] and release the part.

        Raises SafetyError outside the limits or when the fingers would close, and the other errors of `move`.
        """
        state = self._ready("release")
        check_limits(self._limits, width=width, speed=speed)
        check_opens(state, width)
        check_duration(state, width, speed, self._config.move_timeout)
        packet = codec.release(width, speed)
        self._move("release", {"width": width, "speed": speed}, packet, self._config.move_timeout)
        self._settle(lambda s: s.grasp not in ("releasing", "holding"), "done releasing")
        self._grasped = False

    def stop(self) -> None:
        """Stop the fingers. The device also ceases to monitor a held part. No effect in a dry run."""
        if error := self._stop_twice(self._connected()):
            raise error

    def fast_stop(self) -> None:
        """Stop at once and lock every motion until `acknowledge_fault`. No effect in a dry run."""
        self._stop(self._connected(), "fast stop", Command.FAST_STOP)

    def forbid_motion(self, reason: str) -> bool:
        """Refuse every motion until `close`, also one that is prepared and not sent yet. Sends nothing.

        Returns whether a motion is in progress: `stop` ends it.
        """
        self._forbidden = self._forbidden or reason
        if self._link is not None:
            self._link.refuse_prepared()
        return self._moving.locked()

    def acknowledge_fault(self) -> None:
        """Unlock motion after an operator has inspected the fault. Nothing in gelflow calls this by itself.

        No effect in a dry run. Raises PeerRefused when the fault remains.
        """
        link = self._connected()
        self._record("acknowledge fault", {})
        if self._config.dry_run:
            return
        link.request(codec.acknowledge())
        self._acknowledged = link.corrupt
        try:
            self._settle(lambda s: not s.fault, "free of faults")
        except PeerTimeout:
            raise PeerRefused(f"the gripper still reports {self.state().fault} after the acknowledgement") from None

    # Internal

    def _connected(self) -> WsgLink:
        if self._link is None:
            raise UsageError("the gripper is not connected: call connect() first")
        return self._link

    def _record(self, name: str, values: Mapping[str, float]) -> None:
        if self._on_command is not None:
            self._on_command(name, values)

    def _take_update(self, reply: Reply, stamp: float) -> None:
        link = self._link
        with self._changed:
            whole = self._values.update(reply, stamp)
            corrupt = link is not None and link.corrupt > self._acknowledged
            state = self._values.state(corrupt=corrupt) if whole else None
            self._changed.notify_all()
        if state is not None and self._on_measurement is not None:
            self._on_measurement(state)

    def _await(self, reached: Callable[[], bool], what: str) -> None:
        """Wait for an update after which `reached` holds. Raises PeerTimeout, which names `what` did not happen."""
        end = time.monotonic() + max(self._clock.wall(self._config.reply_timeout), SHORTEST_WALL_TIMEOUT)
        link = self._connected()
        with self._changed:
            while not reached():
                left = end - time.monotonic()
                if link.failure is not None:
                    raise PeerError(str(link.failure))
                if left <= 0:
                    raise PeerTimeout(f"the gripper at {link.address} did not {what} within the reply time-out")
                self._changed.wait(min(left, 0.1))

    def _settle(self, reached: Callable[[GripperState], bool], what: str) -> None:
        """After a result: wait for a state that was measured later and is consistent with it."""
        if self._config.dry_run:
            return
        link, since = self._connected(), self._clock.now()

        def agreed() -> bool:
            values = self._values
            return values.oldest > since and reached(values.state(corrupt=link.corrupt > self._acknowledged))

        self._await(agreed, f"report that it is {what}")

    def _ready(self, name: str, *, referenced: bool = True) -> GripperState:
        state = self.state()
        check_ready(name, state, referenced=referenced)
        return state

    def _holds(self, state: GripperState) -> bool:
        return holds_part(state, grasped=self._grasped)

    def _move(
        self, name: str, values: Mapping[str, float], packet: Packet, timeout: float, *, force: float | None = None
    ) -> None:
        """Send a motion and wait for its result. On a failure, stops the fingers and raises PeerRefused."""
        link = self._connected()
        stops = link.stops
        if not self._moving.acquire(blocking=False):
            raise SafetyError(f"{name} refused: another motion is in progress; stop it or wait")
        try:
            if self._forbidden:
                raise SafetyError(f"{name} refused: {self._forbidden}")
            self._record(name, values)
            if self._config.dry_run:
                return
            if force is not None:
                self._limit_force(link, force)
            self._grasped = self._grasped or packet.id == Command.GRASP
            try:
                reply, pending = link.run(packet, timeout=timeout, stops=stops)
            except WsgRefused:  # it was not sent, and a stop would end the grip of a part
                raise
            except BaseException as error:
                _log.error("stopping the gripper: %s failed (%s: %s)", name, type(error).__name__, error)
                self._stop_twice(link)
                raise
            if reply.status == Status.SUCCESS:
                return
            if pending and reply.status not in (Status.CMD_FAILED, Status.CMD_ABORTED):
                _log.error("stopping the gripper: %s failed (%s)", name, reply.status.name)
                self._stop_twice(link)  # blocked fingers would continue to push
            if pending:
                with contextlib.suppress(PeerError):
                    self._settle(lambda _: True, "alive")  # so that `state` shows the result
            text = f"the gripper ended {name} with {reply.status.name}: {meaning(reply.status)}"
            raise WsgRefused(text, status=reply.status, pending=pending)
        finally:
            self._moving.release()

    def _limit_force(self, link: WsgLink, force: float) -> None:
        link.request(codec.set_force_limit(force))
        (confirmed,) = link.request(Packet(Command.GET_FORCE_LIMIT)).values()
        if abs(confirmed - force) > _FORCE_TOLERANCE:
            raise PeerRefused(f"the gripper limits its force to {confirmed:.1f} N, expected {force:.1f} N: not moving")

    def _stop(self, link: WsgLink, name: str, command: Command, *, urgent: bool = True) -> None:
        self._stop_lost = not self._config.dry_run
        try:
            if not self._config.dry_run:
                link.request(Packet(command), urgent=urgent)
                self._stop_lost = False
        finally:
            self._record(name, {})  # after the command, because a stop must not wait for the recorder

    def _stop_twice(self, link: WsgLink) -> GelflowError | None:
        """Stop, again after the pause between commands if it is not confirmed: it was damaged, or came too early."""
        failure: GelflowError | None = None
        for urgent in (True, False):
            try:
                self._stop(link, "stop", Command.STOP, urgent=urgent)
                return None
            except GelflowError as error:
                _log.error("the stop was not confirmed: %s", failure := error)
        return failure
