"""How far a tracker is from the truth: errors, markers that were exchanged, lost and found again, jitter and drift.

Error: the distance between where a marker is said to be and where it is, of all that are said to be measured
(`valid`), in all images after the first. A marker is exchanged when it is said to be measured, but is nearer to
another marker's place than to its own, and within 0.3 of the spacing of that place.
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gelflow.errors import GelflowError
from gelflow.perception.benchmark.baselines import Follower

NEAR = 0.1  # of the spacing: a marker nearer to its true place than this is where it should be
_STOLEN = 0.3  # of the spacing: so near to another marker's place it is on that marker's dot


class TrueFrame(Protocol):
    """An image, and what is true in it."""

    @property
    def image(self) -> NDArray[np.uint8]: ...  # B G R
    @property
    def position(self) -> NDArray[np.float64]: ...  # [px], shape (markers, 2), row by row
    @property
    def visible(self) -> NDArray[np.bool_]: ...  # shape (markers,)


@dataclass(frozen=True)
class Course:
    """What one tracker said about one sequence, beside the truth. All over (frames, markers), the first one too."""

    found: NDArray[np.float64]  # [px], shape (frames, markers, 2)
    moved: NDArray[np.float64]  # displacement from rest, as the tracker has it [px], shape (frames, markers, 2)
    valid: NDArray[np.bool_]
    truth: NDArray[np.float64]  # [px], shape (frames, markers, 2)
    visible: NDArray[np.bool_]
    spacing: float  # of the true grid at rest [px]
    failed: str = ""  # why the tracker gave up, if it did: then nothing is valid from there on

    @property
    def off(self) -> NDArray[np.float64]:
        """Distance from the truth [px], shape (frames, markers); NaN where the tracker has no idea."""
        return np.asarray(np.linalg.norm(self.found - self.truth, axis=-1))

    def errors(self) -> NDArray[np.float64]:
        """Of all that is said to be measured after the first image [px]."""
        return np.asarray(self.off[1:][self.valid[1:]])

    def displacement_errors(self) -> NDArray[np.float64]:
        """Of the displacement from rest, of all that is said to be measured after the first image [px].

        What a damaged dot's middle is off by is off at rest too, and not in here.
        """
        off = np.linalg.norm(self.moved - (self.truth - self.truth[0]), axis=-1)
        return np.asarray(off[1:][self.valid[1:]])

    def near(self) -> float:
        """Share of the visible markers that are within 0.1 spacing of the truth, measured or inferred."""
        seen = self.visible[1:]
        return float((self.off[1:][seen] < NEAR * self.spacing).mean()) if seen.any() else 1.0

    def measured(self) -> float:
        """Share of the visible markers that are said to be measured."""
        seen = self.visible[1:]
        return float(self.valid[1:][seen].mean()) if seen.any() else 1.0

    def exchanged(self) -> int:
        """How many markers were on another marker's dot in any image."""
        stolen = np.zeros(self.valid.shape[1], dtype=bool)
        for found, valid, truth in zip(self.found, self.valid, self.truth, strict=True):
            places = np.where(valid[:, None], found, -1e6)
            distance, nearest = cKDTree(truth).query(places)
            stolen |= valid & (nearest != np.arange(len(truth))) & (distance < _STOLEN * self.spacing)
        return int(stolen.sum())

    def recovered(self) -> float:
        """Share of the markers visible in the last image that are measured there, and within 0.1 spacing."""
        seen = self.visible[-1]
        return float((self.valid[-1] & (self.off[-1] < NEAR * self.spacing))[seen].mean())

    def jitter(self) -> float | None:
        """Of a sequence at rest: the median marker's standard deviation over time, along one axis [px].

        None when no marker was measured all the time.
        """
        always = self.valid.all(axis=0)
        return float(np.median(self.found[:, always].std(axis=0))) if always.any() else None

    def drift(self) -> float | None:
        """Of a sequence that ends as it began: the median marker's displacement at its end [px].

        None when no marker was measured there.
        """
        last = self.moved[-1, self.valid[-1]]
        return float(np.median(np.linalg.norm(last, axis=-1))) if len(last) else None


@dataclass(frozen=True)
class Figures:
    """A tracker on a class of images."""

    median: float  # endpoint error [px]; infinite when nothing was measured
    high: float  # its 95th percentile [px]
    displacement_median: float  # error of the displacement from rest [px]; infinite as above
    displacement_high: float  # its 95th percentile [px]
    near: float  # share of the visible markers within 0.1 spacing
    measured: float  # share of the visible markers that are measured
    exchanged: int  # markers, in all sequences together
    recovered: float  # share of what is visible in the last images that is found there
    failed: tuple[str, ...] = ()  # why, one for each sequence that the tracker gave up

    @classmethod
    def of(cls, courses: Iterable[Course]) -> "Figures":
        """Of several sequences together."""
        courses = list(courses)
        median, high = _percentiles([course.errors() for course in courses])
        displacement_median, displacement_high = _percentiles([course.displacement_errors() for course in courses])
        return cls(
            median=median,
            high=high,
            displacement_median=displacement_median,
            displacement_high=displacement_high,
            near=float(np.mean([course.near() for course in courses])),
            measured=float(np.mean([course.measured() for course in courses])),
            exchanged=sum(course.exchanged() for course in courses),
            recovered=float(np.mean([course.recovered() for course in courses])),
            failed=tuple(course.failed for course in courses if course.failed),
        )

    def plain(self) -> dict[str, Any]:
        """For JSON, which knows no infinity: None."""
        found = asdict(self)
        return {name: None if value == np.inf else value for name, value in found.items()}


def _percentiles(errors: list[NDArray[np.float64]]) -> tuple[float, float]:
    """Median and 95th percentile of all of them; infinite where there are none."""
    joined = np.concatenate(errors)
    return (float(np.median(joined)), float(np.percentile(joined, 95))) if len(joined) else (np.inf, np.inf)


def follow(frames: Iterable[TrueFrame], rows: int, cols: int, followers: Mapping[str, Follower]) -> dict[str, Course]:
    """Lets each of `followers` see `frames`, which start at rest and show `rows` × `cols` markers."""
    said: dict[str, list[Any]] = {name: [] for name in followers}
    failed = dict.fromkeys(followers, "")
    truth: list[NDArray[np.float64]] = []
    visible: list[NDArray[np.bool_]] = []
    for frame in frames:
        image = frame.image
        for name, follower in followers.items():
            nowhere = np.full_like(frame.position, np.nan)
            nothing = nowhere, nowhere, np.zeros(rows * cols, dtype=bool)
            try:
                if failed[name]:
                    said[name].append(nothing)
                elif truth:
                    said[name].append(follower.track(image))
                else:
                    said[name].append(follower.start(image, frame.position, frame.visible, rows, cols))
            except GelflowError as error:
                failed[name] = str(error)
                said[name].append(nothing)
        truth.append(frame.position)
        visible.append(frame.visible)
    at_rest = truth[0].reshape(rows, cols, 2)
    spacing = float(np.median(np.linalg.norm(np.diff(at_rest, axis=1), axis=-1)))
    return {
        name: Course(
            found=np.array([one[0] for one in all_said]),
            moved=np.array([one[1] for one in all_said]),
            valid=np.array([one[2] for one in all_said]),
            truth=np.array(truth),
            visible=np.array(visible),
            spacing=spacing,
            failed=failed[name],
        )
        for name, all_said in said.items()
    }
