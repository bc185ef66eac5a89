"""Controller of the mock IRB 120 in a helper process; started by `gelflow.hardware_mocks.egm.device`."""

import gc
import math
import os
import random
import select
import socket
import sys
from collections import deque
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any

from gelflow.clock import Clock, ScaledClock, raise_priority
from gelflow.errors import PeerError, SafetyError, UsageError
from gelflow.geometry import PoseTuple, angle_between, compose, invert
from gelflow.hardware_mocks.message_faults import MessageFault, MessageFaults
from gelflow.helper_process import Messages, connect_to_parent
from gelflow.real.egm.codec import EgmFeedback, EgmReference, decode_sensor, encode_robot
from gelflow.real.kinematics import HOME, Joints, forward, inverse
from gelflow.time_sync import CONTROLLER, MAX_LEAD, MIN_WAIT

_IDENTITY: PoseTuple = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


@dataclass(frozen=True)
class MockEgmConfig:
    """Settings of the controller. Times are in robot time."""

    host: str = "127.0.0.1"  # UCDevice: destination of the feedback
    port: int = 6510
    period: float = 0.004  # between messages [s]
    lag: float = 0.010  # time constant of the controller's filter, in addition to the plant's lag [s]
    joint_speed: float = math.radians(1.0)  # MaxSpeedDeviation [rad/s]
    comm_timeout: float = 0.2  # EGM ends without an answer for this time [s]
    restart_after: float = 1.0  # the RAPID program restarts EGM after this time [s]
    tool: PoseTuple = _IDENTITY  # the plant's tool in the flange frame: position [m], quaternion w x y z
    near: Joints = HOME  # selects the closest joint solution for the first pose [rad]
    convergence: tuple[float, float, float] = (1e-3, math.radians(0.5), 1.0)  # distance [m], angle [rad], time [s]

    def __post_init__(self) -> None:
        for name in ("period", "lag", "joint_speed", "comm_timeout", "restart_after"):
            if not getattr(self, name) > 0:
                raise UsageError(f"{name} must be above 0, got {getattr(self, name)}")
        if not 0 < self.port < 65536:
            raise UsageError(f"port must be 1 to 65535, got {self.port}")


@dataclass
class MockEgmReport:
    """Snapshot of the controller's state and counters."""

    state: str = "waiting"  # waiting (for an answer), running, ended
    reason: str = ""  # of the last end of EGM
    sessions: int = 1  # number of starts of EGM
    sent: int = 0  # messages sent
    answers: int = 0  # references received
    invalid: int = 0  # datagrams that were not references
    late: int = 0  # cycles that were skipped because this computer was busy
    first_error: float = 0.0  # distance from the pose to the first reference of the session [m]
    largest_step: float = 0.0  # between two references while running, per cycle [m]
    largest_turn: float = 0.0  # between two references while running, per cycle [rad]
    last_sequence: int = -1  # message count of the last answer


def joints_of(config: MockEgmConfig, pose: PoseTuple, near: Joints) -> Joints:
    """Joint angles [rad] of the plant's tool at `pose`. Raises SafetyError when there are none within the ranges."""
    position, quaternion = compose(pose, invert(config.tool))
    return inverse(position, quaternion, near=near)


class Controller:
    """The controller without I/O: computes one message per cycle from the answers."""

    def __init__(self, config: MockEgmConfig, clock: Clock, pose: PoseTuple) -> None:
        self._config = config
        self._clock = clock
        self.report = MockEgmReport()
        self.pose = pose  # last known pose of the plant
        self._joints = joints_of(config, pose, config.near)  # commanded joint angles
        self._target_joints = self._joints  # of the newest reference
        self._measured_joints, self._measured_at = self._joints, pose  # joint angles of the plant's pose
        self._recent: deque[tuple[PoseTuple, Joints]] = deque(maxlen=4)  # last commands to the plant
        self._reference: EgmReference | None = None
        self._late_before = 0  # skipped cycles until this reference
        self._motors = self._rapid = True
        self._random = random.Random(0)
        self.links = {direction: MessageFaults(ordered=False) for direction in ("in", "out")}
        self._frozen: dict[int, bytes] = {}  # the feedback that a fault repeats, by its number
        self._newest = b""  # feedback
        self._blocked: set[int] = set()  # faults that keep the arm from moving
        self._lose, self._loss = 0, 0.0
        self._silenced: set[int] = set()  # faults that keep the arm from sending and receiving
        self._silent_until = -math.inf
        self._sequence = self._ticks = 0
        self._unanswered = self._settled = self._ended = 0.0

    def motors(self, on: bool) -> None:
        self._motors = on
        if not on:
            self._end("motors off")

    def rapid(self, running: bool) -> None:
        self._rapid = running
        if not running:
            self._end("RAPID stopped")

    def restart_sequence(self) -> None:
        self._sequence = 0

    def lose(self, count: int, share: float) -> None:
        self._lose, self._loss = count, share

    def silence(self, seconds: float) -> None:
        self._silent_until = self._clock.now() + seconds

    def begin_fault(self, number: int, kind: str, direction: str, values: dict[str, Any]) -> None:
        """Begin a fault: freeze (feedback repeats), stall (no motion), disconnect or one of the messages."""
        if kind == "freeze":
            self._frozen[number] = self._newest
        elif kind == "stall":
            self._blocked.add(number)
        elif kind == "disconnect":
            self._silenced.add(number)
        else:
            for name, link in self.links.items():
                if direction in (name, "both"):
                    link.begin(number, MessageFault(kind, **values))

    def end_fault(self, number: int) -> None:
        """End the fault with this number."""
        self._frozen.pop(number, None)
        self._blocked.discard(number)
        self._silenced.discard(number)
        for link in self.links.values():
            link.end(number)

    def receive(self, data: bytes) -> None:
        """Process a datagram: start or continue to follow."""
        if self._is_silent():
            return
        report, last = self.report, self._reference
        try:
            reference = decode_sensor(data)
        except PeerError:
            report.invalid += 1
            return
        report.answers += 1
        report.last_sequence = reference.sequence
        self._unanswered = 0.0
        if report.state == "waiting" and self._motors and self._rapid:
            report.state = "running"
            report.first_error = math.dist(self.pose[0], reference.position)
        if report.state != "running":
            return
        if last is not None:
            cycles = 1 + report.late - self._late_before  # the sender moves on in cycles that this computer skipped
            step = math.dist(last.position, reference.position)
            turn = angle_between(last.quaternion, reference.quaternion)
            report.largest_step = max(report.largest_step, step / cycles)
            report.largest_turn = max(report.largest_turn, turn / cycles)
        self._reference, self._late_before = reference, report.late
        if last is None or (last.position, last.quaternion) != (reference.position, reference.quaternion):
            try:
                self._target_joints = joints_of(
                    self._config, (reference.position, reference.quaternion), self._target_joints
                )
            except SafetyError as error:
                self._end(f"a reference is out of range: {error}")

    def cycle(self, periods: int) -> tuple[bytes | None, PoseTuple | None]:
        """Advance by `periods` periods; returns the message to send and the new pose command of the plant."""
        elapsed = periods * self._config.period
        report = self.report
        self._ticks += periods
        report.late += periods - 1
        move = None
        if report.state == "running":
            move = self._move(elapsed)
            # Skipped cycles sent no message, so they count once.
            self._unanswered += self._config.period
            if self._unanswered > self._config.comm_timeout:
                self._end(f"no answer for {self._config.comm_timeout} s")
        elif report.state == "ended" and self._motors and self._rapid and self._rested():
            self._begin()
        self._newest = encode_robot(self._feedback(elapsed))
        self._sequence += 1
        data = next(iter(self._frozen.values()), self._newest)
        return (None if self._is_lost() else data), move

    def _is_lost(self) -> bool:
        if self._lose > 0:
            self._lose -= 1
            return True
        lost = self._is_silent() or self._random.random() < self._loss
        self.report.sent += not lost
        return lost

    def _is_silent(self) -> bool:
        return bool(self._silenced) or self._clock.now() < self._silent_until

    def _rested(self) -> bool:
        return self._clock.now() - self._ended > self._config.restart_after

    def _begin(self) -> None:
        self._sequence = 0
        self._reference = None
        self._unanswered = 0.0
        self.report.state = "waiting"
        self.report.sessions += 1

    def _end(self, reason: str) -> None:
        """End EGM: the arm holds its position."""
        if self.report.state != "ended":
            self.report.state, self.report.reason = "ended", reason
            self._ended = self._clock.now()
            self._target_joints = self._joints
            self._reference = None

    def _move(self, elapsed: float) -> PoseTuple | None:
        if self._blocked:
            return None
        share = 1 - math.exp(-elapsed / self._config.lag)
        change = [(w - q) * share for w, q in zip(self._target_joints, self._joints, strict=True)]
        largest = max(map(abs, change))
        if largest == 0.0:
            return None
        # Scale all joints equally, so that the tool stays on its path.
        scale = min(1.0, self._config.joint_speed * elapsed / largest)
        a, b, c, d, e, f = (q + scale * d for q, d in zip(self._joints, change, strict=True))
        self._joints = (a, b, c, d, e, f)
        pose = compose(forward(self._joints), self._config.tool)
        self._recent.append((pose, self._joints))
        return pose

    def _feedback(self, elapsed: float) -> EgmFeedback:
        self._update_measured_joints()
        running = self.report.state == "running"
        self._settled = self._settled + elapsed if running and self._near() else 0.0
        return EgmFeedback(
            sequence=self._sequence,
            time=self._ticks * self._config.period,
            position=self.pose[0],
            quaternion=self.pose[1],
            joints=self._measured_joints,
            motors="on" if self._motors else "off",
            mci="running" if running else "stopped",
            rapid="running" if self._rapid else "stopped",
            converged=self._settled >= self._config.convergence[2],
        )

    def _update_measured_joints(self) -> None:
        """Update the joint angles of the plant's pose: those of a recent command, otherwise by inverse kinematics."""
        if self.pose == self._measured_at:
            return
        self._measured_at = self.pose
        for pose, joints in self._recent:
            if pose == self.pose:
                self._measured_joints = joints
                return
        try:
            self._measured_joints = joints_of(self._config, self.pose, self._measured_joints)
        except SafetyError as error:
            self._end(f"the arm is out of range: {error}")

    def _near(self) -> bool:
        if self._reference is None:
            return False
        within, turned, _ = self._config.convergence
        apart = math.dist(self.pose[0], self._reference.position)
        return apart <= within and angle_between(self.pose[1], self._reference.quaternion) <= turned


class _Loop:
    """Sends messages on time, receives answers, and exchanges poses with the parent, which owns the plant."""

    def __init__(self, controller: Controller, config: MockEgmConfig, clock: ScaledClock, parent: Messages) -> None:
        self._controller = controller
        self._config = config
        self._clock = clock
        self._parent = parent
        self._asked: float | None = None  # robot time of a request that the parent has not answered yet [s]
        self._move: PoseTuple | None = None
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._udp.bind(("", 0))
        self._udp.setblocking(False)

    def run(self) -> None:
        """Run until the parent ends; received answers are processed once per cycle, as on the controller."""
        grandparent = os.getppid()
        due = self._clock.now()
        while not self._parent.closed and os.getppid() == grandparent:
            self._wait_until(due)
            self._listen()
            # The controller's time continues while this computer is busy: missed cycles are skipped.
            missed = int((self._clock.now() - due) / self._config.period)
            due += (1 + missed) * self._config.period
            data, move = self._controller.cycle(1 + missed)
            self._send(data)
            self._move = move or self._move
            if self._asked is None:
                self._parent.send(["cycle", self._move])
                self._asked, self._move = due, None

    def _send(self, data: bytes | None) -> None:
        link, now = self._controller.links["out"], self._clock.now()
        if data is not None:
            link.put(data, now)
        for message in link.take(now):
            with suppress(OSError):  # a datagram that is too long is lost
                self._udp.sendto(message, (self._config.host, self._config.port))

    def _wait_until(self, due: float) -> None:
        """Wait for the next cycle; robot time waits for late cycles and for the plant's answer.

        Without the parent, whose answer may never come, it returns at once.
        """
        while not self._parent.closed:
            self._clock.grant(CONTROLLER, MAX_LEAD + (due if self._asked is None else self._asked))
            left = due - self._clock.now()
            if left <= 0:
                return
            if self._asked is None:
                self._clock.sleep_until(due)
            elif select.select((self._parent,), (), (), max(self._clock.wall(left), MIN_WAIT))[0]:
                self._handle_parent()

    def _listen(self) -> None:
        self._handle_parent()
        link, now = self._controller.links["in"], self._clock.now()
        with suppress(BlockingIOError):
            while True:
                data, sender = self._udp.recvfrom(4096)
                if sender[1] == self._config.port:
                    link.put(data, now)
        for message in link.take(now):
            self._controller.receive(message)

    def _handle_parent(self) -> None:
        for kind, *values in self._parent.read():
            if kind == "pose":
                position, quaternion = values
                self._controller.pose = (tuple(position), tuple(quaternion))
                self._asked = None
            else:
                self._execute(*values)

    def _execute(self, number: int, name: str, *values: Any) -> None:
        if name != "report":
            getattr(self._controller, name)(*values)
        self._parent.send(["done", number, asdict(self._controller.report)])


def main(arguments: list[str]) -> int:
    """Entry point; started by `MockEgmArm`."""
    settings, parent, _ = connect_to_parent(arguments)
    clock = ScaledClock(*settings["clock"])
    config = MockEgmConfig(**{name: _tuple(value) for name, value in settings["config"].items()})
    controller = Controller(config, clock, _tuple(settings["pose"]))
    raise_priority()
    gc.disable()
    with suppress(ConnectionError):
        _Loop(controller, config, clock, parent).run()
    clock.grant(CONTROLLER, math.inf)
    return 0


def _tuple(value: Any) -> Any:
    """Convert lists to tuples, because JSON has only lists."""
    return tuple(map(_tuple, value)) if isinstance(value, list) else value


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
