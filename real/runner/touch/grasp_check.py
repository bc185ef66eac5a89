"""Check of the pads at every grasp: both must show the part's weight, which also scales the contact thresholds.

The weight of the grasped part pulls the markers of both pads towards the fingertips. A camera whose image shows no such
change, or a change in another direction, does not observe its pad: it repeats an old image, belongs to another finger
or is mounted differently than the lab file states. Fingers that close on a part without parallel sides also shear the
pads sideways, with opposite forces on the part; as the y axes of the pads are opposite too, this shear is the mean of
both y components. The size of the change gives the scale of the thresholds. A threshold below it is exceeded before a
held part can slip, because contact from below first takes the weight off the pads.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import PeerError
from gelflow.real.runner.lab import DescentSettings
from gelflow.real.runner.touch.observer import TactileReading

_WEIGHT_FRACTION = 0.7  # largest contact threshold / change by the weight
_FAST_FRACTION = 0.3  # smallest threshold of fast motions / change by the weight; the motion alone caused 0.14
_NOISE_FACTOR = 5.0  # a change is significant above this multiple of the noise of one reading
_LEAST_NOISE = 3e-4  # lower limit of the estimated noise, because a few readings may agree by chance [mm]
_LARGEST_ANGLE = 45.0  # between the change and the finger's axis [°]
_SIDES = ("left", "right")

Array = NDArray[np.float64]


class TouchImplausible(PeerError):
    """The pads do not show the change that a grasp or a release must have caused."""


@dataclass(frozen=True)
class TouchThresholds:
    """Mean change of shear of a pad since a reference [mm]."""

    contact: float  # contact: the part is not free
    fast: float  # contact in fast motions far above the hole: on a soft gel the motion alone exceeds `contact`
    stop: float  # a descent stops at once
    stuck: float  # an upward motion stops: the part is held by something else


@dataclass(frozen=True)
class GraspCheck:
    """Result of the check at one grasp."""

    weight: Array  # mean change of each pad by the part's weight [mm], shape (sensors, 2): x, y on the pad
    noise: float  # standard deviation of the mean change of a pad between readings at rest [mm]
    thresholds: TouchThresholds

    def shows_weight(self, change: Array) -> bool:
        """Whether the pads still show the weight; `change` is that of each pad since before the grasp [mm].

        False when something supports the part, or when it slips in a grip that no longer holds it.
        """
        return bool(self.weight[:, 0].mean() - change[:, 0].mean() < self.thresholds.contact)


def nominal_thresholds(settings: DescentSettings) -> TouchThresholds:
    """The thresholds of the lab file."""
    contact, stop = settings.contact_shear_mm, settings.stop_shear_mm
    return TouchThresholds(contact, contact, stop, 2 * stop)


def check_grasp(
    before: Sequence[TactileReading], after: Sequence[TactileReading], settings: DescentSettings
) -> GraspCheck:
    """Compare the pads before and after a grasp, both at rest, and scale the thresholds.

    The contact threshold is that of the lab file, but at most 70 % of the change by the weight: a gel five times as
    stiff moves its markers a fifth as far. The other thresholds are scaled by the same factor; that of fast motions
    is at least 30 % of the change by the weight.

    Raises TouchImplausible when a pad shows no change, or a change in another direction than that of the weight.
    """
    weight = _mean(after) - _mean(before)
    noise = max(_noise(before), _noise(after), _LEAST_NOISE)
    nominal = nominal_thresholds(settings)
    if not settings.weight_check:
        return GraspCheck(weight, noise, nominal)
    least = _NOISE_FACTOR * noise
    grip_shear = float(weight[:, 1].mean())  # sideways, by the grip and not by the weight
    for side, (x, y) in zip(_SIDES, weight, strict=False):
        size = float(np.hypot(x, y))
        if size < least:
            raise TouchImplausible(
                f"{side} camera: the pad shows no weight of the grasped part ({size:.4f} mm of mean shear, noise "
                f"{noise:.4f} mm); check that this camera is live, on its finger, and that nothing supports the part"
            )
        if x < least or abs(np.degrees(np.arctan2(y - grip_shear, x))) > _LARGEST_ANGLE:
            angle = float(np.degrees(np.arctan2(y, x)))
            raise TouchImplausible(
                f"{side} camera: the shear by the part's weight is {angle:+.0f}° from the direction to the fingertip; "
                f"check rotation_deg, mirrored and the gripper's orientation in the lab file"
            )
    contact = min(nominal.contact, _WEIGHT_FRACTION * float(weight[:, 0].min()))
    if contact < least:
        raise TouchImplausible(
            f"contact cannot be distinguished from noise: its threshold would be {contact:.4f} mm, the noise is "
            f"{noise:.4f} mm; the gels are too stiff or the part is too light (descent.weight_check = false omits this "
            "check)"
        )
    scale = contact / nominal.contact
    fast = max(contact, _FAST_FRACTION * float(weight[:, 0].min()))
    return GraspCheck(weight, noise, TouchThresholds(contact, fast, scale * nominal.stop, scale * nominal.stuck))


def check_release(held: Sequence[TactileReading], released: Sequence[TactileReading], check: GraspCheck) -> None:
    """Raise TouchImplausible when a pad shows no change as the fingers open: it has not observed the insertion."""
    change = np.abs(_mean(released) - _mean(held)).max(axis=1)
    for side, size in zip(_SIDES, change, strict=False):
        if size < _NOISE_FACTOR * check.noise:
            raise TouchImplausible(
                f"{side} camera: the pad shows no change at the release ({size:.4f} mm), so the part does not count as "
                "inserted: check that this camera is live, then inspect the part"
            )


def _mean(readings: Sequence[TactileReading]) -> Array:
    return np.asarray(np.mean([reading.change for reading in readings], axis=0))


def _noise(readings: Sequence[TactileReading]) -> float:
    return float(np.std([reading.change for reading in readings], axis=0).max())
