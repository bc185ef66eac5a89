"""Summary of a tracking run: shares of tracked markers, jitter at rest, largest displacement, speed."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.perception.force.estimator import ForceEstimate
from gelflow.perception.force.image_forces import force_record
from gelflow.perception.mount_check import VisiblePart
from gelflow.perception.output.slip_summary import SlipSummary
from gelflow.perception.output.writers import TrackedImage
from gelflow.perception.tracker import TrackingResult

_SCALE = 1 / (0.6745 * np.sqrt(6))  # from the median of |a − 2 b + c| to the standard deviation of each term
_MIN_TRIPLES = 8  # of images, for an estimate of the jitter


@dataclass
class TrackingSummary:
    """Statistics over the images of a run; stores no image."""

    images: int = 0
    complete: bool = False  # the run did not end with an error; otherwise the files may be incomplete
    seconds: list[float] = field(default_factory=list)  # tracking time of each image [s]
    largest: float = -1.0  # displacement [px]
    largest_mm: float | None = None
    largest_at: str = ""  # image and marker of the largest displacement
    first: TrackingResult | None = None
    pixels_per_mm: float | None = None  # uniform scale, where it is known and there is no calibration
    largest_normal: ForceEstimate | None = None  # the forces of the image with the largest normal force
    largest_normal_at: str = ""  # this image
    slip: SlipSummary = field(default_factory=SlipSummary)
    visible: list[VisiblePart] = field(default_factory=list)  # possible visible parts of a partly visible grid
    _valid: list[float] = field(default_factory=list)  # share of each image
    _inferred: list[float] = field(default_factory=list)
    _noise: list[float] = field(default_factory=list)  # of each three consecutive images [px]
    _newest: list[NDArray[np.float64]] = field(default_factory=list)

    def add(self, step: TrackedImage, seconds: float) -> None:
        """Add an image and its tracking time [s]."""
        tracked = step.tracked
        self.first = self.first or tracked
        self.images += 1
        self.seconds.append(seconds)
        self._valid.append(float(tracked.valid.mean()))
        self._inferred.append(float(tracked.inferred.mean()))
        measured = np.where(tracked.valid[:, None], tracked.displacement, np.nan)
        # Positions, because displacements of the first images contain the noise of a reference that changes.
        self._newest = [*self._newest[-2:], np.where(tracked.valid[:, None], tracked.position, np.nan)]
        if len(self._newest) == 3:
            noise = _noise(self._newest[0] - 2 * self._newest[1] + self._newest[2], tracked.position)
            self._noise += [] if noise is None else [noise]
        self.slip.add(step)
        force, largest = step.force, self.largest_normal
        if force is not None and (largest is None or force.normal > largest.normal):
            self.largest_normal, self.largest_normal_at = force, step.frame.name
        length = np.nan_to_num(np.linalg.norm(measured, axis=1), nan=-1.0)
        marker = int(length.argmax())
        if length[marker] > self.largest:
            self.largest = float(length[marker])
            row, col = divmod(marker, tracked.cols)
            self.largest_at = f"{step.frame.name}, row {row}, col {col}"
            if step.displacement_mm is not None:
                self.largest_mm = float(np.linalg.norm(step.displacement_mm[marker]))

    def jitter(self) -> float | None:
        """Noise of a marker at rest along one axis, as standard deviation [px]; None with too few images.

        Estimated from second differences in time after removal of an affine motion of all markers, in the quietest
        quarter of the images, in which the gel is most likely at rest.
        """
        if len(self._noise) < _MIN_TRIPLES:
            return None
        return float(np.median(np.sort(self._noise)[: max(2, len(self._noise) // 4)]))

    def frame_seconds(self) -> float:
        """Median tracking time of an image [s], without the first one, in which the grid is detected."""
        return float(np.median(self.seconds[1:] or self.seconds))

    def to_json(self) -> dict[str, Any]:
        """The statistics as plain data. At least one image must have been added."""
        assert self.first is not None
        return {
            "images": self.images,
            "complete": self.complete,
            "rows": self.first.rows,
            "cols": self.first.cols,
            "spacing_px": self.first.spacing,
            "printed_grid": (self.visible[0].rows, self.visible[0].cols) if self.visible else None,
            "visible_rows": self._lines(0),
            "visible_cols": self._lines(1),
            "pixels_per_mm": self.pixels_per_mm,
            "tracked_share": float(np.mean(self._valid)),
            "tracked_share_min": min(self._valid),
            "inferred_share": float(np.mean(self._inferred)),
            "jitter_px": self.jitter(),
            "largest_displacement_px": self.largest if self.largest >= 0 else None,
            "largest_displacement_mm": self.largest_mm,
            "largest_displacement_at": self.largest_at,
            "force": None if self.largest_normal is None else force_record(self.largest_normal),
            "force_at": None if self.largest_normal is None else self.largest_normal_at,
            "slip": self.slip.to_json() if self.largest_normal is not None else None,
            "seconds_per_image": self.frame_seconds(),
            "seconds_first_image": self.seconds[0],
        }

    def _lines(self, axis: int) -> tuple[int, int] | None:
        """First and last visible row (axis 0) or column, from 1; None where unknown or all are visible."""
        return self.visible[0].lines[axis] if len(self.visible) == 1 else None


def _noise(second: NDArray[np.float64], position: NDArray[np.float64]) -> float | None:
    """Noise of the second differences in time `second` [px], shape (markers, 2), after removal of an affine motion."""
    known = np.isfinite(second).all(axis=1)
    if known.sum() < 2 * 3:
        return None
    terms = np.column_stack([np.ones(len(position)), position])[known]
    motion = terms @ np.linalg.lstsq(terms, second[known], rcond=None)[0]
    return float(np.median(np.abs(second[known] - motion)) * _SCALE)
