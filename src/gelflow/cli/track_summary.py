"""The numbers that `gelflow track` tells at its end. No command."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from gelflow.cli.track_output import Step
from gelflow.perception.tracker import TrackingResult

_SCALE = 1 / (0.6745 * np.sqrt(6))  # from the median of |a − 2 b + c| to the standard deviation of each
_FEWEST = 8  # triples of images from which jitter is told


@dataclass
class Summary:
    """Grows with each image; holds no image."""

    images: int = 0
    seconds: list[float] = field(default_factory=list)  # that tracking one image took
    largest: float = -1.0  # displacement [px]
    largest_mm: float | None = None
    where: str = ""
    _valid: list[float] = field(default_factory=list)  # shares
    _inferred: list[float] = field(default_factory=list)
    _noise: list[float] = field(default_factory=list)  # of each three images in a row [px]
    _newest: list[NDArray[np.float64]] = field(default_factory=list)
    _first: TrackingResult | None = None

    def add(self, step: Step, seconds: float) -> None:
        """One more image, and how long tracking it took [s]."""
        tracked = step.tracked
        self._first = self._first or tracked
        self.images += 1
        self.seconds.append(seconds)
        self._valid.append(float(tracked.valid.mean()))
        self._inferred.append(float(tracked.inferred.mean()))
        measured = np.where(tracked.valid[:, None], tracked.displacement, np.nan)
        self._newest = [*self._newest[-2:], measured]
        if len(self._newest) == 3:
            noise = _noise(self._newest[0] - 2 * self._newest[1] + self._newest[2], tracked.position)
            self._noise += [] if noise is None else [noise]
        length = np.nan_to_num(np.linalg.norm(measured, axis=1), nan=-1.0)
        marker = int(length.argmax())
        if length[marker] > self.largest:
            self.largest = float(length[marker])
            row, col = divmod(marker, tracked.cols)
            self.where = f"{step.frame.name}, row {row}, col {col}"
            if step.displacement_mm is not None:
                self.largest_mm = float(np.linalg.norm(step.displacement_mm[marker]))

    def jitter(self) -> float | None:
        """Noise of a marker at rest, one axis, one standard deviation [px]; None when there are too few images.

        From how each marker's place differs from the middle between the images before and after, less what all
        markers do together, in the quietest quarter of the images, where the gel is most likely at rest.
        """
        if len(self._noise) < _FEWEST:
            return None
        return float(np.median(np.sort(self._noise)[: max(2, len(self._noise) // 4)]))

    def table(self, wall: float, written: Sequence[str]) -> Table:
        """All of it; `wall` [s] is how long everything took."""
        assert self._first is not None
        first = self._first
        table = Table(show_header=False)
        table.add_row("images", str(self.images))
        table.add_row("markers", f"{first.valid.size}: {first.rows} rows of {first.cols}, {first.spacing:.1f} px apart")
        worst = f"in the worst image {100 * min(self._valid):.1f} %"
        table.add_row("tracked", f"{100 * np.mean(self._valid):.1f} % ({worst})")
        table.add_row("inferred", f"{100 * np.mean(self._inferred):.1f} %, guessed from neighbours")
        jitter = self.jitter()
        quiet = f"{jitter:.3f} px, in the quietest quarter of the images" if jitter is not None else "too few images"
        table.add_row("rest jitter", quiet)
        if self.largest >= 0:
            share = f"{self.largest / first.spacing:.2f} of the spacing"
            mm = f", {self.largest_mm:.3f} mm" if self.largest_mm is not None else ""
            table.add_row("largest motion", f"{self.largest:.2f} px, {share}{mm} ({self.where})")
        # The first image is another matter: in it the grid is found.
        usual = float(np.median(self.seconds[1:] or self.seconds))
        told = f"{1 / usual:.0f} a second tracked ({1e3 * usual:.2f} ms each, the first {1e3 * self.seconds[0]:.0f} ms)"
        table.add_row("speed", f"{told}, {self.images / wall:.0f} a second with reading and writing")
        for file in written:
            table.add_row("written", file)
        return table


def _noise(second: NDArray[np.float64], position: NDArray[np.float64]) -> float | None:
    """Standard deviation behind second differences in time [px], shape (markers, 2), beside an affine motion of all."""
    known = np.isfinite(second).all(axis=1)
    if known.sum() < 2 * 3:
        return None
    terms = np.column_stack([np.ones(len(position)), position])[known]
    motion = terms @ np.linalg.lstsq(terms, second[known], rcond=None)[0]
    return float(np.median(np.abs(second[known] - motion)) * _SCALE)
