"""Incipient and gross slip of a contact, image by image.

Two cues are independent of each other:

- **Load.** With the friction coefficient μ, T = |shear| / (μ normal force) shows how close a contact is to gross slip;
  a moment about the normal enters as in an elliptic limit surface (Howe and Cutkosky 1996). Before, the contact slips
  from its edge inwards. In an elastic layer the part of the area that sticks is nearly (1 − T)^β, with β from 0.5 for
  flat objects with rounded edges to 0.7 for balls (a ball on a half space: 2/3, Cattaneo 1938, Mindlin 1949). For
  loads that rise and fall, this is the response of parallel elements that each stick up to a limit of their own
  (Iwan 1967), driven with the measured load.
- **Motion.** The markers move with the surface of the gel. A contact that sticks moves with them; in gross slip the
  centre of pressure moves on over the markers, while the markers under it stop. This cue needs no friction coefficient
  and thereby finds it.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.observation import Grid
from gelflow.perception.force.estimator import ForceEstimate, checked_displacement
from gelflow.perception.force.partial_slip import PartialSlip

Array = NDArray[np.float64]

# Measured on balls, rounded discs, cylinders and edges, see docs/guide/sensing/slip.md.
_EXPONENT, _EXPONENT_DEVIATION = 0.57, 0.1  # β
_RATIO_BIAS, _RATIO_DEVIATION = 1.04, 0.03  # of the estimated shear / normal force of a contact that slips in part
_LOAD_NOISE = 0.14  # of T: smaller changes are noise, not a motion backwards
_SMALLEST_DEVIATION = 0.03  # of the share that sticks
# Logistic regression of gross slip on: 1, slide, share of the drag in the motion, drag [pitches] and, if known, T.
_WITH_LOAD, _GROSS_WITH_LOAD = (-21.1, 36.0, -1.3, -43.9, 20.0), 0.6
_MOTION_ONLY, _GROSS_BY_MOTION = (-2.9, 43.1, -2.8, -52.1), 0.7
_WINDOW = 0.025  # time over which motions are compared, and at least one image [s]
_MEMORY = 0.1  # [s]
_SMALLEST_FRICTION, _LARGEST_GROWTH = 0.1, 0.05  # without a known friction: shear / normal, growth of the normal force
_CERTAIN, _CERTAIN_IMAGES = 0.9, 2  # of a gross slip that shows the friction
_OBSERVED_DEVIATION = 0.08  # of a friction coefficient that a gross slip showed, relative


@dataclass(frozen=True)
class SlipEstimate:
    """Slip of a contact. Without a contact nothing slips."""

    stick_share: float | None  # of the contact area; None without a contact and while the friction is not known
    stick_share_deviation: float | None  # standard deviation
    gross: bool  # the whole contact slips
    since: float | None  # stamp of the first image of this gross slip [s]
    confidence: float | None  # probability that `gross` is right; None where motion and forces do not show it
    friction: float | None  # coefficient; None while it is not known
    friction_observed: bool  # found from a gross slip, not stated


@dataclass(frozen=True)
class _Sample:
    stamp: float
    centre: Array  # of pressure [pitches]
    surface: Array  # mean displacement under the contact [pitches]
    normal: float  # force [N]


class SlipEstimator:
    """Slip from the forces and displacements of successive images."""

    def __init__(self, grid: Grid, *, friction: float | None = None, friction_deviation: float = 0.0) -> None:
        """`friction` is the coefficient between gel and objects; where None, a gross slip has to show it first.

        `friction_deviation` is its standard deviation, relative. Raises UsageError for a friction that is not above 0
        and a deviation that is not from 0 to below 1.
        """
        if friction is not None and not 0 < friction < math.inf:
            raise UsageError(f"friction must be above 0, got {friction:g}")
        if not 0 <= friction_deviation < 1:
            raise UsageError(f"friction_deviation must be at least 0 and below 1, got {friction_deviation:g}")
        self._pitch = grid.pitch * 1e-3
        self._positions = grid.positions() / grid.pitch
        self._stated = friction
        self._friction, self._deviation = friction, friction_deviation
        self._stated_deviation = friction_deviation
        self._history: deque[_Sample] = deque()
        self._certain: list[float] = []  # ratios of forces in a certain gross slip
        self._since: float | None = None
        self._slip = PartialSlip(_EXPONENT, _LOAD_NOISE)

    def reset(self) -> None:
        """Clear the history, and a friction coefficient that it showed."""
        self._friction, self._deviation = self._stated, self._stated_deviation
        self._clear_contact()

    def estimate(
        self, force: ForceEstimate | None, displacement: Array, valid: NDArray[np.bool_], stamp: float
    ) -> SlipEstimate | None:
        """The slip in one image, or None where the forces are not known.

        Parameters
        ----------
        force: of the same image, in the axes of the displacements
        displacement: from rest [m], shape (markers, 2), along rows and columns of the grid; ignored where not valid
        valid: whether a marker is measured, shape (markers,)
        stamp: time of the image [s]; the contact counts as a new one where it does not increase

        Raises UsageError for arrays of another shape, valid displacements that are not finite, and such a stamp.
        """
        displacement, valid = checked_displacement(displacement, valid, len(self._positions))
        if not math.isfinite(stamp):
            raise UsageError(f"stamp must be finite, got {stamp}")
        weights = None if force is None else np.where(valid, force.normal_field, 0.0)
        if self._history and stamp <= self._history[-1].stamp:
            self._clear_contact()
        if force is None or weights is None or not force.contact or weights.sum() <= 0:
            self._clear_contact()
            if force is None or force.contact:
                return None
            return SlipEstimate(None, None, False, None, 1.0, self._friction, self._observed())
        surface = weights @ np.where(valid[:, None], displacement, 0.0) / (weights.sum() * self._pitch)
        centre = force.normal_field @ self._positions / force.normal_field.sum()
        self._history.append(_Sample(stamp, centre, surface, force.normal))
        while self._history[0].stamp < stamp - _MEMORY and len(self._history) > 2:
            self._history.popleft()
        ratio = self._ratio(force, centre)
        size = float(np.linalg.norm(ratio))
        probability, limit = self._gross_probability(force.shear, size)
        gross = probability is not None and probability > limit
        if not gross:
            self._since = None
        elif self._since is None:
            self._since = stamp
        self._observe_friction(probability or 0.0, size)
        share, deviation = self._share(ratio, gross)
        return SlipEstimate(
            stick_share=share,
            stick_share_deviation=deviation,
            gross=gross,
            since=self._since,
            confidence=probability if gross or probability is None else 1 - probability,
            friction=self._friction,
            friction_observed=self._observed(),
        )

    def _ratio(self, force: ForceEstimate, centre: Array) -> Array:
        """Shear / normal force and moment / its normal force and mean lever, shape (3,)."""
        weights = force.normal_field / force.normal_field.sum()
        lever = float(weights @ np.linalg.norm(self._positions - centre, axis=1)) * self._pitch
        return np.array([*force.shear, force.moment / max(lever, 1e-9)]) / (force.normal * _RATIO_BIAS)

    def _gross_probability(self, shear: Array, size: float) -> tuple[float | None, float]:
        """Probability of gross slip, and that from which on it is stated.

        The probability is None where a contact of unknown friction is loaded or has hardly any shear.
        """
        slide, drag, growth = self._motion(shear)
        cues = [1.0, min(max(slide, -0.05), 0.15), drag / (max(slide, 0.0) + drag + 0.02), min(drag, 0.06)]
        factors: tuple[float, ...] = _MOTION_ONLY
        limit = _GROSS_BY_MOTION
        if self._friction is None and (size < _SMALLEST_FRICTION or growth > _LARGEST_GROWTH):
            return None, limit
        if self._friction is not None and not self._observed():
            cues.append(min(max(size / self._friction, 0.7), 1.02))
            factors, limit = _WITH_LOAD, _GROSS_WITH_LOAD
        evidence = float(np.dot(factors, cues))
        return 1 / (1 + math.exp(-evidence)), limit

    def _motion(self, shear: Array) -> tuple[float, float, float]:
        """Motion along the shear [pitches] of the centre of pressure over the markers, and of the markers (absolute);
        change of the normal force, relative.
        """
        now = self._history[-1]
        before = now
        for before in reversed(list(self._history)[:-1]):
            if before.stamp <= now.stamp - _WINDOW:
                break
        along = shear / max(float(np.linalg.norm(shear)), 1e-12)
        slide, drag = (now.centre - before.centre) @ along, (now.surface - before.surface) @ along
        return float(slide), abs(float(drag)), now.normal / before.normal - 1

    def _observe_friction(self, probability: float, size: float) -> None:
        """Take the ratio of forces in a certain gross slip for the friction, where none is stated."""
        if self._stated is not None:
            return
        self._certain = [*self._certain, size] if probability > _CERTAIN else []
        if len(self._certain) >= _CERTAIN_IMAGES:
            self._friction, self._deviation = float(np.mean(self._certain)), _OBSERVED_DEVIATION

    def _share(self, ratio: Array, gross: bool) -> tuple[float | None, float | None]:
        """The share that sticks and its deviation."""
        if self._friction is None:
            return (0.0, _SMALLEST_DEVIATION) if gross else (None, None)
        share = self._slip.follow(ratio / self._friction)
        if gross:
            share = 0.0
        deviation = math.hypot(_RATIO_DEVIATION, self._deviation)
        low, high = (_share_after((1 - share ** (1 / _EXPONENT)) * (1 + sign * deviation)) for sign in (1, -1))
        by_shape = share * math.log(max(share, 1e-3)) / _EXPONENT * _EXPONENT_DEVIATION
        return share, math.hypot(_SMALLEST_DEVIATION, (high - low) / 2, by_shape)

    def _observed(self) -> bool:
        return self._stated is None and self._friction is not None

    def _clear_contact(self) -> None:
        self._history.clear()
        self._certain, self._since = [], None
        self._slip = PartialSlip(_EXPONENT, _LOAD_NOISE)


def _share_after(load: float) -> float:
    """The share that sticks after a load that only grew."""
    return float(max(0.0, 1 - load) ** _EXPONENT)
