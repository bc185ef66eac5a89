"""Helper process that exchanges EGM messages with the robot; started by `EgmArm` only.

It runs nothing else, so that no camera, policy or recorder delays an answer, and it ends when its parent ends.
"""

import gc
import math
import os
import select
import socket
import sys
from contextlib import suppress
from typing import Any

from gelflow.clock import ScaledClock, raise_priority
from gelflow.errors import PeerError
from gelflow.geometry import PoseTuple
from gelflow.helper_process import Messages, connect_to_parent
from gelflow.real.egm.codec import EgmFeedback, EgmReference, decode_robot, encode_sensor
from gelflow.real.egm.config import EgmConfig
from gelflow.real.egm.cycle_log import EgmCycle, EgmCycleLog
from gelflow.real.egm.reference_generator import EgmEvent, EgmFlag, ReferenceGenerator
from gelflow.real.egm.target import Target
from gelflow.time_sync import ARM_DRIVER

_LARGEST_MESSAGE = 4096
# Period of the check that the parent still runs [s, wall]: the closed link does not show it while another process holds
# the parent's end of the link.
_PARENT_CHECK = 0.05
_SHORTEST_WAIT = 2e-4  # [s, wall]
# Lead of a mock robot's time over the instant up to which this process has handled all messages, at most [s, wall]. It
# is more than two waits, or robot time would stand still while the robot is silent.
_LONGEST_GAP = 3 * _PARENT_CHECK


class EgmLoop:
    """Waits for messages of the robot and commands of the parent, and answers each message once."""

    def __init__(self, config: EgmConfig, clock: ScaledClock, udp: socket.socket, parent: Messages, log: EgmCycleLog):
        self._config = config
        self._clock = clock
        self._udp = udp
        self._parent = parent
        self._cycles = log
        self._generator = ReferenceGenerator(config)
        self._robot: tuple[str, int] | None = None
        self._sent = 0

    def run(self, *, priority: str = "normal") -> None:
        """Run until the parent ends. An exception ends the process, and nothing is sent to the robot any more.

        `priority` of this thread is reported.
        """
        parent = os.getppid()
        sources: list[socket.socket | Messages] = [self._udp, self._parent]
        self._flush()
        self._event("listening", f"{priority} priority")
        start = self._clock.now()
        while not self._parent.closed and os.getppid() == parent:
            # All messages that the robot sent before `start` are in the log: a pose in it is never older than the lead,
            # whenever this process is interrupted.
            self._clock.grant(ARM_DRIVER, start + self._clock.factor * _LONGEST_GAP)
            start = self._clock.now()
            self._report()
            # The time-out ends just after the instant at which the feedback becomes stale.
            left = self._clock.wall(self._generator.due - self._clock.now()) + _SHORTEST_WAIT
            wait = min(max(left, _SHORTEST_WAIT), _PARENT_CHECK)
            readable, _, _ = select.select(sources, (), (), wait)
            if self._parent in readable:
                for command in self._parent.read():
                    self._execute(*command)
            if self._udp in readable:
                self._answer()
            self._generator.check_age(self._clock.now())

    def _flush(self) -> None:
        """Discard messages that arrived while this process was starting."""
        with suppress(BlockingIOError):
            while True:
                self._udp.recvfrom(_LARGEST_MESSAGE)

    def _execute(self, kind: str, *values: Any) -> None:
        now = self._clock.now()
        if kind == "target":
            position, quaternion, expires, speed, turn_speed = values
            self._generator.set_target(Target(tuple(position), tuple(quaternion), expires, speed, turn_speed), now)
        elif kind == "hold":
            self._generator.hold(now, values[0])
        elif kind == "stop":
            self._generator.stop(values[0], now)
        elif kind == "reset":
            self._robot = None
            self._generator.reset(now)

    def _receive(self, stamp: float) -> list[EgmFeedback]:
        """All pending messages of the robot that are new."""
        messages: list[EgmFeedback] = []
        while True:
            try:
                data, sender = self._udp.recvfrom(_LARGEST_MESSAGE)
            except BlockingIOError:
                return messages
            if not self._is_robot(sender, stamp):
                self._cycles.count(foreign=1)
                continue
            try:
                feedback = decode_robot(data)
            except PeerError as error:
                self._cycles.count(malformed=1)
                if self._cycles.counts.malformed == 1:
                    self._event("malformed", f"from {sender[0]}:{sender[1]}: {error}")
                continue
            if sender != self._robot:
                self._robot = sender
                self._event("first message", f"from {sender[0]}:{sender[1]}")
            if self._generator.observe(feedback, stamp):
                messages.append(feedback)
            else:
                self._cycles.count(duplicates=1)

    def _is_robot(self, sender: tuple[str, int], stamp: float) -> bool:
        """Whether a message at `stamp` [s] is the robot's: the sender of the first one is the robot.

        A controller that starts EGM again may send from another port: such a sender replaces one that is silent, unless
        the controller was following references, or the arm is stopped.
        """
        if self._robot is None:
            return self._config.robot in ("", sender[0])
        if sender == self._robot:
            return True
        generator = self._generator
        silent = stamp - generator.received > self._config.silence
        stopped = bool(generator.latched) or EgmFlag.FOLLOWING in generator.flags
        return sender[0] == self._robot[0] and silent and not stopped

    def _answer(self) -> None:
        stamp = self._clock.now()
        messages = self._receive(stamp)
        # Answer the newest only: a burst of answers would move the reference by several cycles at once.
        for feedback in messages[:-1]:
            self._log(feedback, stamp, None, self._generator.flags | EgmFlag.UNANSWERED, math.nan)
        for feedback in messages[-1:]:
            if self._cycles.full:
                self._generator.latch(
                    f"the log is full: {self._config.log_records} cycles were not fetched with drain_log()", stamp
                )
            reference, flags = self._generator.advance(stamp)
            answered = math.nan
            if reference is not None and not self._config.dry_run:
                answered = self._send(EgmReference(self._sent, stamp, *reference))
            sent = None if answered != answered else reference
            self._log(feedback, stamp, sent, flags, answered)

    def _send(self, reference: EgmReference) -> float:
        assert self._robot is not None
        try:
            self._udp.sendto(encode_sensor(reference), self._robot)
        except OSError as error:
            self._generator.latch(f"cannot send to {self._robot[0]}:{self._robot[1]}: {error.strerror}", reference.time)
            return math.nan
        self._sent += 1
        return self._clock.now()

    def _log(
        self, feedback: EgmFeedback, stamp: float, applied: PoseTuple | None, flags: EgmFlag, answered: float
    ) -> None:
        target = self._generator.target
        record = EgmCycle(
            stamp=stamp,
            commanded=(target.position, target.quaternion) if target else None,
            applied=applied,
            measured=(feedback.position, feedback.quaternion),
            joints=feedback.joints,
            flags=flags,
            sequence=feedback.sequence,
            controller_time=feedback.time,
            answered=answered,
        )
        # Events go first, so that a reader of a record can already fetch the event that explains it.
        self._report()
        self._cycles.append(record)

    def _event(self, kind: str, text: str) -> None:
        self._generator.events.append(EgmEvent(self._clock.now(), kind, text))

    def _report(self) -> None:
        for event in self._generator.events:
            # Raises after a second in which the parent reads nothing and the socket's buffer is full: treated as ended.
            self._parent.send(event)
        self._generator.events.clear()


def main(arguments: list[str]) -> int:
    """Entry point; `EgmArm` passes the descriptors of the UDP socket and of the cycle log."""
    settings, parent, (udp_number, log_number) = connect_to_parent(arguments)
    clock = ScaledClock(*settings.pop("clock"))
    config = EgmConfig(**settings)
    udp = socket.socket(fileno=udp_number)
    udp.setblocking(False)
    log = EgmCycleLog(log_number, config.log_records)
    # No reference cycles are created here; a garbage collection would only delay an answer.
    gc.disable()
    with suppress(ConnectionError):
        EgmLoop(config, clock, udp, parent, log).run(priority="real-time" if raise_priority() else "normal")
    clock.grant(ARM_DRIVER, math.inf)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
