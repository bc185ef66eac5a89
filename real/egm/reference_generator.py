"""Generates the reference pose of every EGM cycle: a state machine without I/O.

Waiting: the reference equals the feedback, so that nothing moves when the controller starts to follow. Following: the
reference moves in a straight line to the newest target, with bounded steps, joint speeds and a bounded lead over the
robot. Hold: the reference returns to the robot, which has followed it with a lag, and is then frozen. Latched: nothing
is sent until `reset`.
"""

import math
from contextlib import suppress
from enum import IntFlag
from typing import NamedTuple

from gelflow.errors import SafetyError
from gelflow.geometry import PoseTuple, Quaternion, Vector, compose, dot, invert, multiply
from gelflow.real.egm.codec import EgmFeedback
from gelflow.real.egm.config import EgmConfig
from gelflow.real.egm.target import Target, check_target, tool_frame
from gelflow.real.kinematics import inverse

# UDP may reorder messages by a few; a larger step back means that the controller restarted its counter.
_MAX_REORDERING = 10
_BRAKING_CYCLES = 25  # after which the reference is frozen at the latest


class EgmFlag(IntFlag):
    """Conditions of one cycle."""

    MOTORS_ON = 1
    FOLLOWING = 2  # the controller follows references
    CONVERGED = 4  # the controller's convergence condition is met
    HOLD = 8  # no target: the reference returns to the robot and is frozen
    LAGGING = 16  # the robot lags behind: the reference waits for it
    LOST = 32  # messages before this one are missing
    UNANSWERED = 64  # a newer message had arrived and was answered instead
    LATCHED = 128  # stopped: nothing is sent


class EgmEvent(NamedTuple):
    """A change of state."""

    stamp: float  # robot time [s]
    kind: str  # listening, first message, malformed, following, hold, refused, restarted, stopped, reset
    text: str


class ReferenceGenerator:
    """Computes references from feedback and targets. `now` is robot time [s]."""

    def __init__(self, config: EgmConfig) -> None:
        self._config = config
        self._feedback: EgmFeedback | None = None
        self._received = -math.inf  # robot time of the newest feedback [s]
        self._tool: PoseTuple | None = None
        self._reference: PoseTuple | None = None
        self._target: Target | None = None
        self._rate = 0.0  # fraction of the target's speed, 0 to 1
        # After a hold: cycles left, and the directions of the motion and of the rotation (unit vectors, or zero).
        self._braking: tuple[int, Vector, Vector] | None = None
        self._stopping = ""  # reason of a stop that takes effect when the arm is at rest
        self._following = False
        self._flags = EgmFlag(0)
        self.latched = ""
        self.events: list[EgmEvent] = []  # removed by the caller

    @property
    def target(self) -> Target | None:
        return self._target

    @property
    def received(self) -> float:
        """Robot time of the newest feedback [s]; −inf before the first one."""
        return self._received

    @property
    def flags(self) -> EgmFlag:
        """Flags of the newest feedback."""
        return self._flags

    def observe(self, feedback: EgmFeedback, now: float) -> bool:
        """Process a message. False: it is a duplicate or late, and is neither used nor answered."""
        last = self._feedback
        flags = EgmFlag(0)
        if last is not None:
            behind = last.sequence - feedback.sequence
            if behind == 0 or (0 < behind <= _MAX_REORDERING and feedback.time < last.time):
                return False
            if behind > 0:
                self._restarted(last, feedback, now)
            elif behind < -1:
                flags |= EgmFlag.LOST
            self.check_age(now)
        self._feedback, self._received = feedback, now
        stop_reason = feedback.stop_reason
        if self._reference is None or not self._following:
            # Until the controller follows, the reference equals the measured pose.
            self._reference = (feedback.position, feedback.quaternion)
        if self._following and stop_reason:
            self.latch(stop_reason, now)
        elif not self._following and not stop_reason and not self.latched:
            self._following = True
            self._tool = tool_frame(feedback)
            self._event(now, "following", "the controller follows references")
        if feedback.motors == "on":
            flags |= EgmFlag.MOTORS_ON
        if self._following and not self.latched:
            flags |= EgmFlag.FOLLOWING
        if feedback.converged:
            flags |= EgmFlag.CONVERGED
        self._flags = flags
        return True

    def advance(self, now: float) -> tuple[PoseTuple | None, EgmFlag]:
        """The reference of the next cycle, in answer to the newest feedback; None: nothing may be sent."""
        if self.latched or self._reference is None:
            return None, self._flags | EgmFlag.LATCHED
        if self._target is not None and now >= self._target.expires:
            self.hold(now, "the target expired")
        if self._target is not None:
            try:
                self._reference, lagging = self._step(self._reference, self._target)
            except SafetyError as error:
                self._refuse(f"target refused: {error}", now)
            else:
                return self._reference, self._flags | (EgmFlag.LAGGING if lagging else EgmFlag(0))
        self._brake()
        if self._stopping and self._braking is None:
            self.latch(self._stopping, now)
            return None, self._flags | EgmFlag.LATCHED
        return self._reference, self._flags | EgmFlag.HOLD

    def set_target(self, target: Target, now: float) -> None:
        """Follow `target` from now on; an invalid target is refused and the arm holds."""
        if self.latched or self._stopping:
            return
        if self._feedback is None or self._reference is None or self._tool is None or not self._following:
            self._refuse("target refused: the controller does not follow references", now)
            return
        try:
            check_target(self._config, target, reference=self._reference, tool=self._tool, feedback=self._feedback)
        except SafetyError as error:
            self._refuse(str(error), now)
            return
        self._rate *= self._kept_rate(target)
        self._target, self._braking = target, None

    def hold(self, now: float, reason: str) -> None:
        """Come to rest: the reference returns to the robot in bounded steps, and is then frozen."""
        if self._target is not None and self._reference is not None:
            self._event(now, "hold", reason)
            move, turn = _difference(self._reference, (self._target.position, self._target.quaternion))
            self._braking = (_BRAKING_CYCLES, _direction(move), _direction(turn))
        self._target = None
        self._rate = 0.0

    def stop(self, reason: str, now: float) -> None:
        """Hold, and latch as soon as the arm is at rest."""
        self.hold(now, reason)
        if self._braking is None:
            self.latch(reason, now)
        else:
            self._stopping = self._stopping or reason

    def latch(self, reason: str, now: float) -> None:
        """Stop: nothing is sent until `reset`. The first reason is kept."""
        if not self.latched:
            self.latched = reason
            self._event(now, "stopped", reason)
        self._target, self._rate, self._following = None, 0.0, False
        self._braking, self._stopping = None, ""

    def reset(self, now: float) -> None:
        """Return to the initial state, on the operator's command."""
        self.latched = ""
        self._feedback, self._received = None, -math.inf
        self._tool = self._reference = self._target = self._braking = None
        self._stopping = ""
        self._rate, self._following, self._flags = 0.0, False, EgmFlag(0)
        self._event(now, "reset", "latch cleared by the operator")

    @property
    def due(self) -> float:
        """Robot time at which `check_age` has to be called when no message arrives before [s]."""
        if not self._following or self.latched:
            return math.inf
        moving = self._target is not None or self._stopping
        return self._received + (self._config.stale if moving else self._config.silence)

    def check_age(self, now: float) -> None:
        """Hold, then stop, when no feedback arrives while the controller follows."""
        if not self._following or self.latched:
            return
        age = now - self._received
        if age > self._config.stale and self._stopping:
            self.latch(self._stopping, now)
        elif age > self._config.silence:
            self.latch(f"no EGM message for {age:.3f} s, at most {self._config.silence} s is allowed", now)
        elif age > self._config.stale:
            self.hold(now, f"no EGM message for {age:.4f} s")

    def _restarted(self, last: EgmFeedback, feedback: EgmFeedback, now: float) -> None:
        text = f"EGM was restarted: the message count went back from {last.sequence} to {feedback.sequence}"
        if self._following:
            self.latch(text, now)
        else:
            self._event(now, "restarted", text)

    def _refuse(self, text: str, now: float) -> None:
        self._event(now, "refused", text)
        self.hold(now, "a target was refused")

    def _event(self, now: float, kind: str, text: str) -> None:
        self.events.append(EgmEvent(now, kind, text))

    def _step(self, reference: PoseTuple, target: Target) -> tuple[PoseTuple, bool]:
        """One cycle along the straight line and the shorter rotation, both ending together, with ramps at both ends.

        Returns the new reference and whether it waits for the robot. Raises SafetyError when the path leaves the joint
        ranges.
        """
        cycle, ramp = self._config.cycle, self._config.ramp_time
        move, turn = _difference(reference, (target.position, target.quaternion))
        distance, angle = _length(move), _length(turn)
        # Times at full speed [s]: to the target, and of this cycle.
        remaining = max(distance / target.speed, angle / target.turn_speed)
        if remaining == 0.0:
            return (target.position, target.quaternion), False
        # The rest may take less than a cycle, and is stretched from a whole one.
        stretch = self._joint_stretch(reference, move, turn, min(1.0, cycle / remaining))
        remaining = max(remaining, cycle) * stretch if stretch > 1.0 else remaining
        # Accelerate from rest to full rate in ramp_time; decelerate equally to rest at the target.
        rate = min(1.0, self._rate + cycle / ramp, math.sqrt(2 * remaining / ramp))
        advance = min(rate * cycle, self._allowed_advance(reference, move, turn, remaining))
        lagging = advance < rate * cycle
        # While the reference waits, its rate falls gradually: feedback that is late by a cycle causes no jerk.
        self._rate = max(advance / cycle, rate - 2 * cycle / ramp) if lagging else rate
        if advance >= remaining:
            return (target.position, target.quaternion), False
        return _moved(reference, move, turn, advance / remaining), lagging

    def _joint_stretch(self, reference: PoseTuple, move: Vector, turn: Vector, share: float) -> float:
        """Factor by which a step of `share` of the way must last longer than a cycle to keep the joint speed."""
        assert self._feedback is not None and self._tool is not None
        flange = invert(self._tool)
        here = inverse(*compose(reference, flange), near=self._feedback.joints)
        there = inverse(*compose(_moved(reference, move, turn, share), flange), near=here)
        largest = max(abs(b - a) for a, b in zip(here, there, strict=True))
        return max(1.0, largest / (self._config.joint_speed * self._config.cycle))

    def _allowed_advance(self, reference: PoseTuple, move: Vector, turn: Vector, remaining: float) -> float:
        """Time [s] by which the reference may advance at full speed until its lead is the largest allowed one."""
        assert self._feedback is not None
        config = self._config
        lead, lead_turn = _difference((self._feedback.position, self._feedback.quaternion), reference)
        if _length(lead) > config.max_lead or _length(lead_turn) > config.max_turn_lead:
            return 0.0
        allowed = math.inf
        for way, ahead, margin in ((move, lead, config.lead_margin), (turn, lead_turn, config.turn_lead_margin)):
            speed = _length(way) / remaining
            if speed > 0.0:
                allowed = min(allowed, config.lead_time + (margin - dot(ahead, _direction(way))) / speed)
        return max(0.0, allowed)

    def _brake(self) -> None:
        """One cycle of the return of the reference to the robot, along the line on which it was moving."""
        if self._braking is None or self._reference is None or self._feedback is None:
            return
        count, along, about = self._braking
        lead, lead_turn = _difference((self._feedback.position, self._feedback.quaternion), self._reference)
        back = max(0.0, min(dot(lead, along), self._config.max_speed * self._config.cycle))
        turned = max(0.0, min(dot(lead_turn, about), self._config.max_turn_speed * self._config.cycle))
        move, turn = _scaled(along, -back), _scaled(about, -turned)
        stretch = 1.0
        with suppress(SafetyError):  # outside the joint ranges the arm comes to rest too
            stretch = self._joint_stretch(self._reference, move, turn, 1.0)
        self._reference = _moved(self._reference, move, turn, 1.0 / stretch)
        at_rest = back == turned == 0.0
        self._braking = None if at_rest or count <= 1 else (count - 1, along, about)

    def _kept_rate(self, target: Target) -> float:
        """Fraction of the rate that a new target keeps: the part of the motion that continues in the same direction."""
        assert self._reference is not None
        old = self._target
        if old is None:
            return 0.0
        a, b = (
            [c / t.speed for c in move] + [c / t.turn_speed for c in turn]
            for t in (old, target)
            for move, turn in (_difference(self._reference, (t.position, t.quaternion)),)
        )
        size = math.sqrt(sum(c * c for c in a) * sum(c * c for c in b))
        if size == 0.0:
            return 0.0
        aligned = sum(c * d for c, d in zip(a, b, strict=True)) / size
        return max(0.0, aligned) * min(1.0, old.speed / target.speed)


def _difference(reference: PoseTuple, target: PoseTuple) -> tuple[Vector, Vector]:
    """Displacement [m] in the base frame and rotation vector [rad] in the reference's frame, to the target."""
    (px, py, pz), (rw, rx, ry, rz) = reference
    (x, y, z), quaternion = target
    w, i, j, k = multiply((rw, -rx, -ry, -rz), quaternion)
    if w < 0:
        w, i, j, k = -w, -i, -j, -k
    sine = math.sqrt(i * i + j * j + k * k)
    # The limit of angle / sine is 2; for smaller sines the quotient is dominated by rounding.
    scale = 2 * math.atan2(sine, w) / sine if sine > 1e-12 else 2.0
    return (x - px, y - py, z - pz), (i * scale, j * scale, k * scale)


def _moved(pose: PoseTuple, move: Vector, turn: Vector, share: float) -> PoseTuple:
    """`pose` moved by the fraction `share` of a displacement [m] and of a rotation vector [rad]."""
    (x, y, z), quaternion = pose
    return (x + share * move[0], y + share * move[1], z + share * move[2]), _turned(quaternion, turn, share)


def _turned(quaternion: Quaternion, turn: Vector, share: float) -> Quaternion:
    """`quaternion` rotated by the fraction `share` of the rotation vector `turn` [rad]."""
    angle = _length(turn)
    if angle == 0.0:
        return quaternion
    half = angle * share / 2
    scale = math.sin(half) / angle
    w, x, y, z = multiply(quaternion, (math.cos(half), turn[0] * scale, turn[1] * scale, turn[2] * scale))
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    return (w / norm, x / norm, y / norm, z / norm)


def _length(v: Vector) -> float:
    return math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


def _scaled(v: Vector, factor: float) -> Vector:
    return (factor * v[0], factor * v[1], factor * v[2])


def _direction(v: Vector) -> Vector:
    """The unit vector along `v`; zero for a zero vector."""
    length = _length(v)
    return (0.0, 0.0, 0.0) if length == 0.0 else _scaled(v, 1 / length)
