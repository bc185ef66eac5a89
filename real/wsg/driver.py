"""Driver of the Weiss WSG-50 gripper over its binary protocol, on a serial line or TCP.

Every motion is checked here before a byte of it is sent, waits for its result, and stops the fingers when
something goes wrong. FAST STOP and other faults forbid motion until an operator calls `acknowledge_fault`.
This is no safety-rated function.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Mapping
from types import TracebackType

from gelflow.clock import Clock
from gelflow.errors import GelflowError, PeerError, PeerRefused, PeerTimeout, SafetyError, UsageError
from gelflow.protocols import GripperState
from gelflow.real.transport import SHORTEST_WALL_TIMEOUT, Transport
from gelflow.real.wsg import codec
from gelflow.real.wsg.codec import MM, Packet, Reply
from gelflow.real.wsg.config import WsgConfig, WsgLimits, narrowed
from gelflow.real.wsg.constants import HOME_OUTWARDS, STATE_COMMANDS, Command, Status, UpdateMode
from gelflow.real.wsg.link import WsgLink, WsgRefused
from gelflow.real.wsg.state import StateAssembler

_log = logging.getLogger(__name__)
_log.addHandler(logging.NullHandler())  # a driver prints nothing unless its program asks for it
_WSG_50 = 1  # device type
_SLACK = 0.5e-3  # the measured width may differ this much from where the fingers were sent [m]
_CLAMPED = 2.5  # fingers that press harder than this may hold a part: half the smallest grasping force [N]
_FORCE_MATCH = 0.5  # the force limit that the device confirms may differ this much [N]

_MEANING = {
    Status.CMD_FAILED: "no part was between the fingers",
    Status.AXIS_BLOCKED: "the fingers met something before their target",
    Status.ACCESS_DENIED: "motion is locked, by FAST STOP or by another client",
    Status.NOT_INITIALIZED: "home it first",
    Status.ALREADY_RUNNING: "it is moving, or holds a part",
    Status.CMD_ABORTED: "it was stopped",
    Status.RANGE_ERROR: "outside the device's or its soft limits",
}


OnCommand = Callable[[str, Mapping[str, float]], None]
OnMeasurement = Callable[[GripperState], None]


class WsgGripper:
    """`gelflow.protocols.Gripper` over a WSG-50. No I/O before `connect` (or `with`).

    `on_command(name, values)` is called before a command is sent, values in SI; an exception from it keeps the
    command from being sent (stops are sent first). `on_measurement(state)` is called from the reading thread
    whenever all five state values are new; a GelflowError from it ends the link.
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
        self._acknowledged = 0  # frames with a wrong checksum that the operator knows of
        self._moving = threading.Lock()
        self._grasped = False

    def __enter__(self) -> "WsgGripper":
        self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close(reason="done" if kind is None else f"{kind.__name__}: {error}")

    # ---------------------------------------------------------------- connection

    def connect(self) -> None:
        """Open the transport, check that a WSG-50 answers, start its updates. Nothing moves, nothing is acknowledged.

        Raises PeerError (PeerTimeout, PeerRefused) when no WSG-50 answers, UsageError when already connected.
        """
        if self._link is not None:
            raise UsageError("the gripper is already connected")
        config = self._config
        self._values = StateAssembler()
        self._acknowledged = 0
        self._grasped = False
        link = WsgLink(
            self._transport,
            clock=self._clock,
            on_update=self._take_update,
            reply_timeout=config.reply_timeout,
            command_interval=config.command_interval,
            crc=config.crc,
        )
        self._link = link
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
                link.send(Packet(Command.DISCONNECT))  # closing unannounced would raise FAST STOP
            link.close()
            self._link = None
            raise
        self._acknowledged = link.corrupt  # what the line held from before says nothing about this session
        _log.info("gripper %s at %s, firmware %#06x", serial, link.address, int(firmware))

    def close(self, *, reason: str = "closed by the program") -> None:
        """Stop the fingers, announce the disconnect, close. May be called twice; trouble is logged, not raised.

        While a part is held no stop is sent: the fingers stand still, and a stop would end the device's grip.
        """
        link, self._link = self._link, None
        if link is None:
            return
        _log.info("disconnecting from the gripper at %s: %s", link.address, reason)
        with self._changed:
            held = self._values.complete and self._holds(self._values.state(corrupt=False))
        try:
            farewell = [("disconnect", Command.DISCONNECT)]
            if (self._moving.locked() or not held) and not self._config.dry_run:
                farewell.insert(0, ("stop", Command.STOP))
            for name, command in farewell:
                try:
                    link.request(Packet(command), urgent=True)
                    self._record(name, {})
                except GelflowError as error:
                    _log.error("%s while disconnecting from the gripper: %s", name, error)
        finally:
            link.close()

    # ---------------------------------------------------------------- state

    @property
    def limits(self) -> WsgLimits:
        """What may be asked for: the configured limits, narrowed by the device's own once connected."""
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

    # ---------------------------------------------------------------- motion

    def home(self, *, part_removed: bool = False) -> None:
        """Reference the fingers outwards (inwards would press the gels together); never called by the driver itself.

        Raises SafetyError while a part may be held, unless an operator has looked: `part_removed=True`.
        """
        state = self._ready("home", referenced=False)
        if not part_removed and self._may_hold(state):
            raise SafetyError(
                f"home refused: a part may be held ({state.grasp}, {state.force:.1f} N); release it, "
                f"or have an operator look and say part_removed"
            )
        self._move("home", {"direction": HOME_OUTWARDS}, codec.home(HOME_OUTWARDS), self._config.home_timeout)
        self._settle(lambda s: s.referenced, "referenced")
        self._grasped = False

    def move(self, *, width: float, speed: float) -> None:
        """Move the empty fingers to `width` [m] at `speed` [m/s]; returns when they are there.

        Raises SafetyError outside the limits or while a part is held, PeerRefused when they are blocked.
        """
        state = self._ready("move")
        self._check(width=width, speed=speed)
        if self._holds(state):
            raise SafetyError("move refused: a part is held; release it instead")
        self._check_duration(state, width, speed)
        frame = codec.pre_position(width, speed)
        self._move("move", {"width": width, "speed": speed}, frame, self._config.move_timeout)
        self._settle(lambda s: s.grasp != "positioning", "done positioning")
        self._grasped = False

    def grasp(self, *, width: float, speed: float, force: float) -> None:
        """Close on a part; returns when the device holds it.

        `width` [m] is where contact is expected: the device moves there and then on, through its clamping travel
        (set on the device), until `force` [N] is reached. Contact before that band is AXIS_BLOCKED, none in it is
        CMD_FAILED; both raise PeerRefused. Raises SafetyError outside the limits, when a part is already held, or
        when `width` is above the present opening (the device would open).
        """
        state = self._ready("grasp")
        self._check(width=width, speed=speed, force=force)
        if self._holds(state):
            raise SafetyError("grasp refused: a part is already held; release it first")
        if width > state.width + _SLACK:
            raise SafetyError(
                f"grasp refused: width {width * MM:.1f} mm is above the opening of {state.width * MM:.1f} mm, "
                f"and the fingers would open; move them apart first"
            )
        self._check_duration(state, width, speed)
        before = self._grasped
        try:
            values = {"width": width, "speed": speed, "force": force}
            self._move("grasp", values, codec.grasp(width, speed), self._config.move_timeout, force=force)
        except WsgRefused as error:
            # Anything but a clear "no part" leaves open what is between the fingers.
            if error.status == Status.CMD_FAILED or not error.pending:
                self._grasped = before and error.status != Status.CMD_FAILED
            raise
        self._settle(lambda s: s.grasp == "holding", "holding")

    def release(self, *, width: float, speed: float) -> None:
        """Open to `width` [m] at `speed` [m/s] and let the part go. Raises SafetyError when that would close."""
        state = self._ready("release")
        self._check(width=width, speed=speed)
        if width < state.width - _SLACK:
            raise SafetyError(
                f"release refused: width {width * MM:.1f} mm is below the opening of {state.width * MM:.1f} mm, "
                f"and the fingers would close"
            )
        self._check_duration(state, width, speed)
        frame = codec.release(width, speed)
        self._move("release", {"width": width, "speed": speed}, frame, self._config.move_timeout)
        self._settle(lambda s: s.grasp not in ("releasing", "holding"), "done releasing")
        self._grasped = False

    def stop(self) -> None:
        """Stop the fingers where they are. On the device this also ends a grip's monitoring. Nothing in a dry run."""
        self._stop("stop", Command.STOP)

    def fast_stop(self) -> None:
        """Stop at once and lock every motion until `acknowledge_fault`. Nothing in a dry run."""
        self._stop("fast stop", Command.FAST_STOP)

    def acknowledge_fault(self) -> None:
        """An operator's word that the fault was looked at: unlocks motion. Nothing in gelflow calls it by itself.

        Raises PeerRefused when the fault remains.
        """
        link = self._connected()
        self._record("acknowledge fault", {})
        link.request(codec.acknowledge())
        self._acknowledged = link.corrupt
        try:
            self._settle(lambda s: not s.fault, "free of faults", sent=True)
        except PeerTimeout:
            raise PeerRefused(f"the gripper still reports {self.state().fault} after the acknowledgement") from None

    # ---------------------------------------------------------------- inside

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
        """Wait for an update after which `reached` holds; PeerTimeout says that the gripper did not do `what`."""
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

    def _settle(self, reached: Callable[[GripperState], bool], what: str, *, sent: bool = False) -> None:
        """After a result: wait for a state that was measured later and agrees with it."""
        if self._config.dry_run and not sent:
            return
        link, since = self._connected(), self._clock.now()

        def agreed() -> bool:
            values = self._values
            return values.oldest > since and reached(values.state(corrupt=link.corrupt > self._acknowledged))

        self._await(agreed, f"report that it is {what}")

    def _ready(self, name: str, *, referenced: bool = True) -> GripperState:
        self._connected()
        state = self.state()
        if state.fault:
            raise SafetyError(
                f"{name} refused: the gripper reports {state.fault}; look at it, then acknowledge the fault"
            )
        if referenced and not state.referenced:
            raise SafetyError(f"{name} refused: the gripper is not referenced; home it first")
        return state

    def _holds(self, state: GripperState) -> bool:
        return state.grasp == "holding" or (self._grasped and state.grasp not in ("part lost", "no part"))

    def _may_hold(self, state: GripperState) -> bool:
        return self._holds(state) or state.grasp == "grasping" or state.force > _CLAMPED

    def _check(self, **values: float) -> None:
        for name, value in values.items():
            low, high = getattr(self._limits, name)
            # Written so that NaN fails; float32 on the wire may round a bound by parts in ten million.
            if not low - 1e-9 <= value <= high + 1e-9:
                raise SafetyError(f"{name} {value} is outside {low} to {high} (m, m/s, N): nothing was sent")

    def _check_duration(self, state: GripperState, width: float, speed: float) -> None:
        needed = abs(width - state.width) / speed + 0.5
        if needed > self._config.move_timeout:
            raise UsageError(
                f"{abs(width - state.width) * MM:.0f} mm at {speed * MM:.0f} mm/s take {needed:.1f} s, more than the "
                f"time-out of {self._config.move_timeout} s: choose a higher speed"
            )

    def _move(
        self, name: str, values: Mapping[str, float], frame: Packet, timeout: float, *, force: float | None = None
    ) -> None:
        """Send a motion and wait for its result. Raises PeerRefused naming the status; stops the fingers on trouble."""
        link = self._connected()
        if not self._moving.acquire(blocking=False):
            raise SafetyError(f"{name} refused: another motion is under way; stop it or wait")
        try:
            self._record(name, values)
            if self._config.dry_run:
                return
            if force is not None:
                self._limit_force(link, force)
            self._grasped = self._grasped or frame.id == Command.GRASP
            try:
                reply, pending = link.run(frame, timeout=timeout)
            except BaseException as error:
                self._stop_after(name, f"{type(error).__name__}: {error}")
                raise
            if reply.status == Status.SUCCESS:
                return
            if pending and reply.status not in (Status.CMD_FAILED, Status.CMD_ABORTED):
                self._stop_after(name, reply.status.name)  # blocked fingers would go on pushing
            if pending:
                with contextlib.suppress(PeerError):
                    self._settle(lambda _: True, "still there")  # so that `state` shows what came of it
            meaning = _MEANING.get(reply.status, "see the device's manual")
            text = f"the gripper ended {name} with {reply.status.name}: {meaning}"
            raise WsgRefused(text, status=reply.status, pending=pending)
        finally:
            self._moving.release()

    def _limit_force(self, link: WsgLink, force: float) -> None:
        link.request(codec.set_force_limit(force))
        (confirmed,) = link.request(Packet(Command.GET_FORCE_LIMIT)).values()
        if abs(confirmed - force) > _FORCE_MATCH:
            raise PeerRefused(
                f"the gripper limits its force to {confirmed:.1f} N, expected {force:.1f} N: not grasping"
            )

    def _stop(self, name: str, command: Command) -> None:
        link = self._connected()
        try:
            if not self._config.dry_run:
                link.request(Packet(command), urgent=True)
        finally:
            self._record(name, {})  # after the command: a stop does not wait for the record

    def _stop_after(self, name: str, reason: str) -> None:
        """Stop because `name` went wrong; the first trouble is the one that is raised."""
        _log.error("stopping the gripper: %s went wrong (%s)", name, reason)
        try:
            self._stop("stop", Command.STOP)
        except GelflowError as error:
            _log.error("the stop was not confirmed: %s", error)
