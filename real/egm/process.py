"""The process that talks EGM to the robot: `python -m gelflow.real.egm.process`, started by `EgmArm` only.

It has nothing else to do, so that no camera, policy or recorder can delay an answer. It ends when its parent does.
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

_LARGEST_MESSAGE = 4096
_PARENT_CHECK = 0.1  # [s, wall]: the closed link says it at once, except where another helper holds the parent's end


class EgmLoop:
    """Waits for the robot's messages and the parent's commands, and answers each message once."""

    def __init__(self, config: EgmConfig, clock: ScaledClock, udp: socket.socket, parent: Messages, ring: EgmCycleLog):
        self._config = config
        self._clock = clock
        self._udp = udp
        self._parent = parent
        self._ring = ring
        self._follower = ReferenceGenerator(config)
        self._robot: tuple[str, int] | None = None
        self._sent = 0

    def run(self) -> None:
        """Until the parent is gone or says so. A failure here ends the process: nothing is sent any more."""
        parent = os.getppid()
        sources: list[socket.socket | Messages] = [self._udp, self._parent]
        self._flush()
        self._event("listening", f"{'real-time' if raise_priority() else 'normal'} priority")
        while not self._parent.closed and os.getppid() == parent:
            self._report()
            wait = min(self._clock.wall(self._config.stale) / 2, _PARENT_CHECK)
            readable, _, _ = select.select(sources, (), (), wait)
            if self._parent in readable:
                for command in self._parent.read():
                    self._obey(*command)
            if self._udp in readable:
                self._answer()
            self._follower.check_age(self._clock.now())

    def _flush(self) -> None:
        """Messages that came while this process was starting are history."""
        with suppress(BlockingIOError):
            while True:
                self._udp.recvfrom(_LARGEST_MESSAGE)

    def _obey(self, kind: str, *values: Any) -> None:
        now = self._clock.now()
        if kind == "target":
            position, quaternion, expires, speed, turn_speed = values
            self._follower.post(Target(tuple(position), tuple(quaternion), expires, speed, turn_speed), now)
        elif kind == "hold":
            self._follower.hold(now, values[0])
        elif kind == "stop":
            self._follower.latch(values[0], now)
        elif kind == "reset":
            self._robot = None
            self._follower.reset(now)

    def _receive(self, stamp: float) -> list[EgmFeedback]:
        """All waiting messages of the robot that are new."""
        messages: list[EgmFeedback] = []
        while True:
            try:
                data, sender = self._udp.recvfrom(_LARGEST_MESSAGE)
            except BlockingIOError:
                return messages
            if sender != self._robot and (self._robot or (self._config.robot and sender[0] != self._config.robot)):
                self._ring.count(foreign=1)
                continue
            try:
                feedback = decode_robot(data)
            except PeerError as error:
                self._ring.count(malformed=1)
                if self._ring.counts.malformed == 1:
                    self._event("malformed", f"from {sender[0]}:{sender[1]}: {error}")
                continue
            if self._robot is None:
                self._robot = sender
                self._event("first message", f"from {sender[0]}:{sender[1]}")
            if self._follower.observe(feedback, stamp):
                messages.append(feedback)
            else:
                self._ring.count(duplicates=1)

    def _answer(self) -> None:
        stamp = self._clock.now()
        messages = self._receive(stamp)
        # Only the newest is answered: a burst of answers would move the reference by several cycles at once.
        for feedback in messages[:-1]:
            self._log(feedback, stamp, None, self._follower.flags | EgmFlag.UNANSWERED, math.nan)
        for feedback in messages[-1:]:
            if self._ring.full:
                self._follower.latch(
                    f"the log is full: {self._config.log_records} cycles were not fetched with drain_log()", stamp
                )
            reference, flags = self._follower.advance(stamp)
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
            self._follower.latch(f"cannot send to {self._robot[0]}:{self._robot[1]}: {error.strerror}", reference.time)
            return math.nan
        self._sent += 1
        return self._clock.now()

    def _log(
        self, feedback: EgmFeedback, stamp: float, applied: PoseTuple | None, flags: EgmFlag, answered: float
    ) -> None:
        target = self._follower.target
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
        # Events first: who sees a record in which something has changed, can ask what. Of a full log they have told.
        self._report()
        self._ring.append(record)

    def _event(self, kind: str, text: str) -> None:
        self._follower.events.append(EgmEvent(self._clock.now(), kind, text))

    def _report(self) -> None:
        for event in self._follower.events:
            # A parent that reads nothing for a second while thousands of events lie there is as good as gone.
            self._parent.send(event)
        self._follower.events.clear()


def main(arguments: list[str]) -> int:
    """Started by `EgmArm`, with the UDP socket and the log."""
    settings, parent, (udp_number, ring_number) = connect_to_parent(arguments)
    clock = ScaledClock(*settings.pop("clock"))
    config = EgmConfig(**settings)
    udp = socket.socket(fileno=udp_number)
    udp.setblocking(False)
    ring = EgmCycleLog(ring_number, config.log_records)
    # Nothing here makes cycles of references; a collection would only delay an answer.
    gc.disable()
    with suppress(ConnectionError):
        EgmLoop(config, clock, udp, parent, ring).run()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
