"""Driver of an ABB arm over EGM (externally guided motion).

EGM runs in a helper process (`gelflow.real.egm.process`). The driver checks targets, sends them to that process, and
reads the cycle log from shared memory. This is not a safety-rated function: the safety system of the robot must be
sufficient without it.
"""

import dataclasses
import errno
import math
import os
import socket
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow import interrupts
from gelflow.clock import ScaledClock
from gelflow.errors import PeerError, PeerTimeout, SafetyError, UsageError
from gelflow.geometry import PoseTuple
from gelflow.helper_process import HelperProcess
from gelflow.protocols import ArmState
from gelflow.real.egm.codec import EgmFeedback
from gelflow.real.egm.config import EgmConfig
from gelflow.real.egm.cycle_log import EgmCycle, EgmCycleLog, MessageCounts
from gelflow.real.egm.reference_generator import EgmEvent, EgmFlag
from gelflow.real.egm.target import Target, check_target, tool_frame
from gelflow.real.egm.timing import EgmTiming

# Time-outs of the helper process, independent of the robot's clock [s, wall].
_START_TIMEOUT = 30.0
_COMMAND_TIMEOUT = 1.0
_POLL = 0.002
_BIND_HINTS: dict[int | None, str] = {
    errno.EADDRINUSE: "is another program listening there?",
    errno.EACCES: "choose a port above 1023, here and on the controller",
}


class EgmArm:
    """An ABB IRB 120 as a `gelflow.protocols.Arm`: it follows checked targets in bounded steps over EGM.

    `with` connects and closes; nothing is opened before. The caller must fetch the cycle log with `drain_log`
    regularly: a full log stops the arm, because no cycle may be lost.
    """

    abortable = True

    def __init__(self, config: EgmConfig, *, clock: ScaledClock) -> None:
        self._config = config
        self._clock = clock
        self._lock = threading.RLock()
        self._helper: HelperProcess | None = None
        self._cycles: EgmCycleLog | None = None
        self._events: list[EgmEvent] = []
        self._latched = ""
        self._resets = 0
        self._tool: PoseTuple | None = None
        self.port = config.port  # the UDP port in use; for port 0 it is known after `connect`

    def connect(self, timeout: float | None = None) -> None:
        """Start the EGM process and wait for the first message of the robot.

        `timeout` [s, robot time]; None: that of the configuration. Raises UsageError when the port is in use, and
        PeerTimeout when the robot sends nothing, or PeerError when a deferred signal ends the wait; the process has
        ended then, and `connect` may be called again.
        """
        limit = self._config.connect_timeout if timeout is None else timeout
        if self._helper is not None:
            raise UsageError("the EGM arm is connected already; close() it first")
        try:
            self._start()
            failure = f"the EGM process did not start in {_START_TIMEOUT} s"
            self._wait(lambda: self._received_event("listening"), _START_TIMEOUT, failure)
            self._wait_first_message(limit)
        except BaseException:
            self.close()
            raise

    def wait_following(self, timeout: float) -> None:
        """Wait at most `timeout` [s, robot time] until the controller follows references.

        Raises PeerTimeout with the state of the controller, and SafetyError when the arm is stopped.
        """
        try:
            self._wait(lambda: self._running() or bool(self._latched), self._clock.wall(timeout), "")
        except PeerTimeout:
            motors = "on" if self.state().motors_on else "off"
            raise PeerTimeout(
                f"the controller does not follow EGM within {timeout:g} s (motors {motors}): "
                f"switch the motors on and start the RAPID program with EGMRunPose{self._foreign_text()}"
            ) from None
        self._refuse_when_latched()

    def state(self) -> ArmState:
        """The newest feedback. `operating_mode` is unknown, because EGM does not transmit it.

        Raises PeerTimeout when the newest feedback is older than the configuration's `silence`, and PeerError when the
        EGM process has ended. While latched, returns the last feedback with the reason as `fault`.
        """
        with self._lock:
            record = self._latest()
            self._process_events()  # the event that explains the record was sent before it
            age = self._clock.now() - record.stamp
            if age > self._config.silence and not self._latched:
                limit = self._config.silence
                text = f"the newest EGM message is {age:.3f} s old, at most {limit} s is allowed"
                raise PeerTimeout(text + self._foreign_text())
            return ArmState(
                position=np.array(record.measured[0]),
                quaternion=np.array(record.measured[1]),
                joints=np.array(record.joints),
                stamp=record.stamp,
                motors_on=EgmFlag.MOTORS_ON in record.flags,
                running=EgmFlag.FOLLOWING in record.flags and not self._latched,
                operating_mode="unknown",
                fault=self._latched,
            )

    def reference(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The last reference sent to the robot: position [m], shape (3,); quaternion w x y z, shape (4,).

        Raises PeerError when none was sent.
        """
        record = self._latest()
        if record.applied is None:
            raise PeerError("no reference was sent for the newest EGM message: the arm is stopped or in a dry run")
        return np.array(record.applied[0]), np.array(record.applied[1])

    def target(
        self,
        position: NDArray[np.float64],
        quaternion: NDArray[np.float64],
        *,
        lifetime: float,
        speed: float | None = None,
        turn_speed: float | None = None,
    ) -> None:
        """Move in a straight line to a pose of the controller's tool, for at most `lifetime` seconds; then hold.

        Parameters
        ----------
        position: [m], shape (3,), in the robot's base frame
        quaternion: w x y z, shape (4,)
        lifetime: [s, robot time]; the target must be renewed before it expires
        speed, turn_speed: largest speeds of the reference [m/s, rad/s], at most those of the configuration;
            None: those of the configuration

        Raises SafetyError when the target is refused or the arm is stopped, PeerTimeout on stale feedback. In a dry run
        the target is checked and not sent. Raises UsageError for arrays of another shape.
        """
        if np.shape(position) != (3,) or np.shape(quaternion) != (4,):
            shapes = f"{np.shape(position)} and {np.shape(quaternion)}"
            raise UsageError(f"expected a position (3,) and a quaternion (4,), got shapes {shapes}")
        if not 0 < lifetime <= self._config.max_lifetime:
            raise SafetyError(
                f"target refused: lifetime {lifetime} s is not above 0 and at most {self._config.max_lifetime} s"
            )
        x, y, z = (float(v) for v in position)
        a, b, c, d = (float(v) for v in quaternion)
        with self._lock:
            state = self.state()
            self._refuse_when_latched()
            target = Target(
                (x, y, z),
                _unit((a, b, c, d)),
                expires=self._clock.now() + lifetime,
                speed=self._config.max_speed if speed is None else float(speed),
                turn_speed=self._config.max_turn_speed if turn_speed is None else float(turn_speed),
            )
            record = self._latest()
            if not state.running and not self._config.dry_run:
                raise SafetyError("target refused: the controller does not follow references; is EGM running?")
            feedback = EgmFeedback(record.sequence, record.controller_time, *record.measured, record.joints)
            if self._tool is None:
                self._tool = tool_frame(feedback)
            reference = record.applied or record.measured
            check_target(self._config, target, reference=reference, tool=self._tool, feedback=feedback)
            if not self._config.dry_run:
                self._send("target", *dataclasses.astuple(target))

    def hold(self) -> None:
        """Come to rest: within 25 cycles the reference returns to the measured pose in bounded steps, and stays."""
        with self._lock:
            self._send("hold", "hold was called")

    def stop(self, reason: str) -> None:
        """Send no more references; the controller's CommTimeout ends EGM. Latches until `reset`.

        An EGM process that does not confirm the stop is killed, which has the same effect.
        """
        with self._lock:
            helper = self._helper
        if helper is None:
            return
        try:
            self._send("stop", reason or "stop was called")
            # Without the lock: a thread for which robot time of a mock robot waits may need the state of the arm.
            self._wait(lambda: bool(self._latched), _COMMAND_TIMEOUT, "the EGM process did not confirm the stop")
        except UsageError:
            return  # closed meanwhile
        except PeerError:
            helper.kill()
            with self._lock:
                self._latched = self._latched or reason or "stop was called"

    def reset(self) -> None:
        """Allow motion again after a stop, on the operator's command. The reference restarts at the feedback.

        Raises PeerTimeout when the EGM process does not confirm; it is then killed, so that the reset has no effect
        later. A cause that persists stops the arm again.
        """
        with self._lock:
            before, helper = self._resets, self._linked()
            try:
                self._send("reset")
                self._wait(lambda: self._resets > before, _COMMAND_TIMEOUT, "the EGM process did not confirm the reset")
            except PeerTimeout:
                helper.kill()
                raise

    def drain_log(self) -> list[EgmCycle]:
        """All cycles since the last call."""
        with self._lock:
            return self._opened().drain()

    def drain_events(self) -> list[EgmEvent]:
        """Changes of state since the last call, oldest first."""
        with self._lock:
            self._process_events(tolerant=True)
            events, self._events = self._events, []
            return events

    @property
    def counts(self) -> MessageCounts:
        """Counts of ignored messages."""
        return self._opened().counts

    @property
    def timing(self) -> EgmTiming:
        """Missed cycles, jitter of the messages and times of the answers since `connect`."""
        return self._opened().timing

    @property
    def pid(self) -> int | None:
        """Process id of the EGM process; None when not connected."""
        return None if self._helper is None else self._helper.pid

    def close(self) -> None:
        """End the EGM process. Cycles that were not fetched with `drain_log` are lost."""
        with self._lock:
            if self._helper is not None:
                self._helper.close()
            if self._cycles is not None:
                self._cycles.close()
            self._helper = self._cycles = None
            self._latched, self._tool = "", None

    def __enter__(self) -> "EgmArm":
        if self._helper is None:
            self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _start(self) -> None:
        udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            udp.bind((self._config.host, self._config.port))
        except OSError as error:
            udp.close()
            hint = _BIND_HINTS.get(error.errno, "host must be an IPv4 address of this computer; 0.0.0.0 means all")
            raise UsageError(
                f"cannot listen for EGM on {self._config.host}:{self._config.port}: {error.strerror}; {hint}"
            ) from None
        self.port = udp.getsockname()[1]
        self._events = []
        descriptor = EgmCycleLog.create(self._config.log_records)
        try:
            self._cycles = EgmCycleLog(descriptor, self._config.log_records)
            settings = dataclasses.asdict(self._config) | {"clock": self._clock.settings}
            self._helper = HelperProcess.start(
                "gelflow.real.egm.process", settings, descriptors=(udp.fileno(), descriptor)
            )
        finally:
            udp.close()
            os.close(descriptor)

    def _opened(self) -> EgmCycleLog:
        if self._cycles is None:
            raise UsageError("the EGM arm is not connected; call connect() first")
        return self._cycles

    def _latest(self) -> EgmCycle:
        record = self._opened().latest()
        if record is None:
            raise PeerTimeout(f"no EGM message on UDP port {self.port} yet")
        return record

    def _running(self) -> bool:
        record = self._opened().latest()
        return record is not None and EgmFlag.FOLLOWING in record.flags and not self._latched

    def _wait_first_message(self, limit: float) -> None:
        opened = self._opened()
        try:
            self._wait(lambda: opened.latest() is not None or interrupts.is_pending(), self._clock.wall(limit), "")
        except PeerTimeout:
            raise PeerTimeout(
                f"no EGM message on UDP port {self.port} within {limit:g} s: "
                f"start the RAPID program with EGMRunPose, check UCDevice address{self._foreign_text()}"
            ) from None
        if opened.latest() is None:
            raise PeerError("a signal ended the wait for the first EGM message")

    def _foreign_text(self) -> str:
        """For errors: the number of ignored messages of other senders; empty without any."""
        count = self.counts.foreign
        return f"; {count} messages of other senders were ignored" if count else ""

    def _received_event(self, kind: str) -> bool:
        return any(event.kind == kind for event in self._events)

    def _refuse_when_latched(self) -> None:
        if self._latched:
            raise SafetyError(
                f"the arm is stopped: {self._latched}; after the cause is removed, an operator may reset it"
            )

    def _linked(self) -> HelperProcess:
        if self._helper is None:
            raise UsageError("the EGM arm is not connected; call connect() first")
        return self._helper

    def _process_events(self, *, tolerant: bool = False) -> None:
        """Process the events of the EGM process. Raises PeerError when it has ended, unless `tolerant`."""
        helper = self._linked()
        for event in (EgmEvent(*values) for values in helper.messages.read()):
            self._events.append(event)
            if event.kind == "stopped":
                self._latched = event.text
            elif event.kind == "reset":
                self._latched, self._tool = "", None
                self._resets += 1
        if helper.messages.closed and not tolerant:
            raise PeerError(
                f"the EGM process has ended ({helper.exit_reason()}); nothing is sent to the robot any more"
            )

    def _send(self, *command: Any) -> None:
        helper = self._linked()
        try:
            helper.messages.send(command, limit=_COMMAND_TIMEOUT)
        except TimeoutError:
            raise PeerTimeout(f"the EGM process accepted no command for {_COMMAND_TIMEOUT} s") from None
        except OSError:
            raise PeerError(f"the EGM process has ended ({helper.exit_reason()})") from None

    def _wait(self, done: Callable[[], bool], wall: float, failure: str) -> None:
        """Process events until `done`, for at most `wall` [s, wall]; then raise PeerTimeout with `failure`."""
        deadline = ScaledClock()
        end = deadline.now() + wall
        while True:
            with self._lock:
                self._process_events()
                if done():
                    return
            if deadline.now() > end:
                raise PeerTimeout(failure)
            deadline.sleep(_POLL)


def _unit(q: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """`q` normalized when it is a unit quaternion up to rounding; otherwise unchanged, and the check refuses it."""
    norm = math.sqrt(sum(c * c for c in q))
    if not abs(norm - 1) < 1e-3:
        return q
    return (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)
