"""Guarded motion: every motion of a held part ends at contact, and holds while a pad is not readable."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.clock import ScaledClock
from gelflow.errors import PeerTimeout
from gelflow.geometry import Pose
from gelflow.real.runner.approach_monitor import ARRIVED
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.motion_executor import LONGEST_UNOBSERVED, MotionExecutor
from gelflow.real.runner.phases import Phase
from gelflow.real.runner.touch.observer import TactileObserver, TactileReading
from gelflow.session.recorder import SessionRecorder
from gelflow.time_sync import RUNNER

# From the reception of an image that shows contact to the arm at rest: tracking, hold, lag of the arm [s].
_REACTION_TIME = 0.03
_REST_TIME = 0.1  # from a hold until the arm and the newest images are at rest [s]
_FREE_OVERSHOOT = 0.5e-3  # after contact in motions up, sideways and above the range in which the rim is searched [m]
_DOWNWARD = 0.05e-3  # a target further below the arm than this is a motion towards contact [m]

Array = NDArray[np.float64]


class TouchLost(PeerTimeout):
    """A pad was not readable for longer than the limit while a part was held."""


@dataclass(frozen=True)
class Contact:
    """Contact that ended a motion."""

    reading: TactileReading
    change: float  # of the mean shear, as measured for the threshold [mm]


def along_finger(change: Array) -> float:
    """Shear along the finger, the larger of both pads [mm]; `change` is the mean of each pad, shape (sensors, 2)."""
    return float(np.abs(change[:, 0]).max())


def downward(change: Array) -> float:
    """Shear towards the fingertip, the larger of both pads [mm]: the part is pulled out of the grip."""
    return float(change[:, 0].max())


def in_any_direction(change: Array) -> float:
    """Magnitude of the shear, the larger of both pads [mm]."""
    return float(np.hypot(change[:, 0], change[:, 1]).max())


class GuardedMotion:
    """Moves a held part while both pads are observed.

    `excess_latency` is the measured delay of the images beyond that in the lab file [s].
    """

    def __init__(
        self,
        motion: MotionExecutor,
        observer: TactileObserver,
        lab: Lab,
        clock: ScaledClock,
        recorder: SessionRecorder,
        *,
        excess_latency: float = 0.0,
    ) -> None:
        self._motion, self.observer = motion, observer
        self._lab, self._clock, self._recorder = lab, clock, recorder
        self._latency = max(lab.cameras.left.latency, lab.cameras.right.latency) + excess_latency

    @property
    def free_speed(self) -> float:
        """Largest speed where contact is not expected [m/s], such that the arm stops within 0.5 mm after contact."""
        return self._speed(_FREE_OVERSHOOT)

    def speed_towards(self, target: Pose) -> float:
        """Largest speed of a motion to `target` [m/s]; downward, the arm stops within `descent.max_overshoot`."""
        downward_motion = self._motion.pose().position[2] - target.position[2] > _DOWNWARD
        return self._speed(self._lab.descent.max_overshoot) if downward_motion else self.free_speed

    def _speed(self, overshoot: float) -> float:
        """Speed at which the arm travels `overshoot` [m] during image latency, image period and reaction time."""
        delay = self._latency + self.observer.image_period + _REACTION_TIME
        return min(self._lab.arm.max_speed, overshoot / delay)

    def move(
        self,
        target: Pose,
        *,
        threshold: float,
        measure: Callable[[Array], float],
        baseline: Array | None = None,
        speed: float | None = None,
        within: float = ARRIVED[0],
        deadline: float = math.inf,
        on_reading: Callable[[TactileReading], bool] = lambda reading: False,
    ) -> Contact | None:
        """Move to `target`; returns the contact that ended the motion, or None at the target.

        Parameters
        ----------
        target: gripper frame in the base frame
        threshold: value of `measure` that is contact [mm]
        measure: contact measure of the mean change of each pad, shape (sensors, 2) [mm]
        baseline: mean change of each pad that is no contact [mm], shape (sensors, 2); None: zero
        speed: [m/s]; None: `speed_towards` the target
        within: distance from the target at which the motion has ended [m]
        deadline: robot time after which the motion ends with PeerTimeout [s]
        on_reading: called with every reading; its return value True ends the motion as at contact

        Raises TouchLost when a pad is not readable for `limits.stale_frame`, PeerTimeout when the arm does not arrive.
        The arm holds before a pad was unreadable for 250 ms.
        """
        zero = np.zeros((2, 2)) if baseline is None else baseline
        speed = self.speed_towards(target) if speed is None else speed
        # A mock robot's time waits for this loop: on a busy computer the arm would travel on before an image is seen.
        with self._clock.bounded(RUNNER) as renew:
            self._start(target, speed)
            approach = self._motion.approach_monitor(target)
            while not self._motion.arrived(within=within):
                renew()
                self._motion.wait(0.0)
                reading = self.observer.update()
                if reading is not None:
                    change = measure(reading.change - zero)
                    # `on_reading` is called for the reading at contact too.
                    if on_reading(reading) or change > threshold:
                        self._motion.hold()
                        return Contact(reading, change)
                age = self.observer.unreadable_time()
                if age >= LONGEST_UNOBSERVED:
                    self._motion.hold()
                    self._wait_until_readable(age)
                    self._start(target, speed)
                    approach = self._motion.approach_monitor(target)
                elif not self._motion.report_observation(age):  # this thread was delayed
                    self._start(target, speed)
                approach.check()
                self._check_deadline(deadline)
        return None

    def _start(self, target: Pose, speed: float) -> None:
        """Start or continue a motion, after a hold until there are images that are new enough."""
        if self.observer.unreadable_time() >= LONGEST_UNOBSERVED:
            self.observer.update()  # this thread may have been delayed: newer images may have arrived
        if self.observer.unreadable_time() >= LONGEST_UNOBSERVED:
            self._motion.hold()
            self._wait_until_readable(0.0)
        self._motion.start_motion(target, speed=speed, guarded=True, age=self.observer.unreadable_time())

    def rest(self) -> TactileReading | None:
        """A reading of both pads at rest: the cameras are not synchronized, so pads in motion are inconsistent."""
        self._motion.wait(_REST_TIME)
        return self.observer.update_pair(self._clock.now())

    def _wait_until_readable(self, unreadable: float) -> None:
        """Hold until both pads are readable again. Raises TouchLost after `limits.stale_frame`.

        `unreadable` [s] counts to this time: how long a pad in motion was not readable. Late images may be readable and
        still too old, so the duration of the hold is limited as well.
        """
        phases = self._motion.supervisor.phases
        before = phases.phase
        phases.enter(Phase.HOLD)
        values = {"camera": self.observer.unreadable_camera, "seconds": self.observer.unreadable_time()}
        self._recorder.event("pad not readable", values)
        begun = self._clock.now() - unreadable
        while self.observer.unreadable_time() >= LONGEST_UNOBSERVED:
            if (seconds := self._clock.now() - begun) > self._lab.limits.stale_frame:
                raise TouchLost(
                    f"camera {self.observer.unreadable_camera}: no readable image in time for {seconds:.2f} s with a "
                    "part held, which is longer than limits.stale_frame; check the gel, its light and the camera"
                )
            self._motion.wait(0.0)
            with self._clock.bounded(RUNNER):
                self.observer.update()
        phases.enter(before)

    def _check_deadline(self, deadline: float) -> None:
        if self._clock.now() > deadline:
            self._motion.hold()
            raise PeerTimeout(f"an attempt took more than {self._lab.limits.attempt_time:g} s; does the arm follow?")
