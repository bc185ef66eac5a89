"""Metrics of tracked sequences with ground truth: errors, identity switches, visibility, jitter and drift.

An error is the distance between the estimated and the true position of a measured (`valid`) marker, in all images
after the first. An identity switch is a measured marker that is closer to the true position of another marker than to
its own, and within 0.3 spacings of it.
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gelflow.errors import GelflowError
from gelflow.perception.benchmark.baselines import BenchmarkTracker, MarkerEstimate

NEAR_RADIUS = 0.1  # largest error of a correctly located marker / spacing
_SWITCH_RADIUS = 0.3  # distance from another marker that counts as a switch / spacing


class FrameWithTruth(Protocol):
    """An image with its ground truth."""

    @property
    def image(self) -> NDArray[np.uint8]: ...  # B G R
    @property
    def position(self) -> NDArray[np.float64]: ...  # [px], shape (markers, 2), row by row
    @property
    def visible(self) -> NDArray[np.bool_]: ...  # shape (markers,)


@dataclass(frozen=True)
class TrackedSequence:
    """The estimates of one tracker for one sequence, and the truth. Arrays have shape (frames, markers, ...)."""

    position: NDArray[np.float64]  # [px], shape (frames, markers, 2)
    displacement: NDArray[np.float64]  # estimated displacement from rest [px], shape (frames, markers, 2)
    valid: NDArray[np.bool_]
    truth: NDArray[np.float64]  # [px], shape (frames, markers, 2)
    visible: NDArray[np.bool_]
    spacing: float  # true marker spacing at rest [px]
    failed: str = ""  # message of the error that ended tracking, if any; nothing is valid from there on

    @property
    def distances(self) -> NDArray[np.float64]:
        """Distance from the true position [px], shape (frames, markers); NaN without an estimate."""
        return np.asarray(np.linalg.norm(self.position - self.truth, axis=-1))

    def errors(self) -> NDArray[np.float64]:
        """Position errors of all measured markers after the first image [px]."""
        return np.asarray(self.distances[1:][self.valid[1:]])

    def displacement_errors(self) -> NDArray[np.float64]:
        """Displacement errors of all measured markers after the first image [px].

        They exclude the constant position error of a damaged dot.
        """
        distances = np.linalg.norm(self.displacement - (self.truth - self.truth[0]), axis=-1)
        return np.asarray(distances[1:][self.valid[1:]])

    def near(self) -> float:
        """Fraction of the visible markers within 0.1 spacings of the true position, measured or inferred."""
        visible = self.visible[1:]
        return float((self.distances[1:][visible] < NEAR_RADIUS * self.spacing).mean()) if visible.any() else 1.0

    def measured(self) -> float:
        """Fraction of the visible markers that are measured."""
        visible = self.visible[1:]
        return float(self.valid[1:][visible].mean()) if visible.any() else 1.0

    def identity_switches(self) -> int:
        """Number of markers with an identity switch in any image."""
        switched = np.zeros(self.valid.shape[1], dtype=bool)
        for position, valid, truth in zip(self.position, self.valid, self.truth, strict=True):
            positions = np.where(valid[:, None], position, -1e6)
            distance, nearest = cKDTree(truth).query(positions)
            switched |= valid & (nearest != np.arange(len(truth))) & (distance < _SWITCH_RADIUS * self.spacing)
        return int(switched.sum())

    def recovered(self) -> float:
        """Fraction of the markers visible in the last image that are measured there within 0.1 spacings."""
        visible = self.visible[-1]
        return float((self.valid[-1] & (self.distances[-1] < NEAR_RADIUS * self.spacing))[visible].mean())

    def jitter(self) -> float | None:
        """Standard deviation of the median marker over time along one axis [px], for a sequence at rest.

        None when no marker is measured in all images.
        """
        always = self.valid.all(axis=0)
        return float(np.median(self.position[:, always].std(axis=0))) if always.any() else None

    def drift(self) -> float | None:
        """Median displacement in the last image [px], for a sequence that ends at rest.

        None when no marker is measured there.
        """
        last = self.displacement[-1, self.valid[-1]]
        return float(np.median(np.linalg.norm(last, axis=-1))) if len(last) else None


@dataclass(frozen=True)
class TrackingMetrics:
    """Metrics of a tracker on a class of images."""

    median: float  # position error [px]; infinite when nothing is measured
    percentile_95: float  # 95th percentile of the position error [px]
    displacement_median: float  # displacement error [px]; infinite when nothing is measured
    displacement_percentile_95: float  # 95th percentile of the displacement error [px]
    near: float  # fraction of the visible markers within 0.1 spacings of the true position
    measured: float  # fraction of the visible markers that are measured
    identity_switches: int  # markers, summed over the sequences
    recovered: float  # fraction of the markers visible in the last images that are measured there
    failed: tuple[str, ...] = ()  # one error message per sequence in which tracking ended early

    @classmethod
    def from_sequences(cls, sequences: Iterable[TrackedSequence]) -> "TrackingMetrics":
        """Metrics over several sequences."""
        sequences = list(sequences)
        median, percentile_95 = _percentiles([sequence.errors() for sequence in sequences])
        displacement_median, displacement_percentile_95 = _percentiles(
            [sequence.displacement_errors() for sequence in sequences]
        )
        return cls(
            median=median,
            percentile_95=percentile_95,
            displacement_median=displacement_median,
            displacement_percentile_95=displacement_percentile_95,
            near=float(np.mean([sequence.near() for sequence in sequences])),
            measured=float(np.mean([sequence.measured() for sequence in sequences])),
            identity_switches=sum(sequence.identity_switches() for sequence in sequences),
            recovered=float(np.mean([sequence.recovered() for sequence in sequences])),
            failed=tuple(sequence.failed for sequence in sequences if sequence.failed),
        )

    def to_dict(self) -> dict[str, Any]:
        """JSON data; infinity becomes None."""
        return {name: None if value == np.inf else value for name, value in asdict(self).items()}


def _percentiles(errors: list[NDArray[np.float64]]) -> tuple[float, float]:
    """Median and 95th percentile of all errors; infinite without errors."""
    joined = np.concatenate(errors)
    return (float(np.median(joined)), float(np.percentile(joined, 95))) if len(joined) else (np.inf, np.inf)


def run_trackers(
    frames: Iterable[FrameWithTruth], rows: int, cols: int, trackers: Mapping[str, BenchmarkTracker]
) -> dict[str, TrackedSequence]:
    """Runs `trackers` on `frames`, which start at rest and show `rows` × `cols` markers.

    A tracker that raises GelflowError measures nothing from that image on.
    """
    estimates: dict[str, list[MarkerEstimate]] = {name: [] for name in trackers}
    failed = dict.fromkeys(trackers, "")
    truth: list[NDArray[np.float64]] = []
    visible: list[NDArray[np.bool_]] = []
    for frame in frames:
        image = frame.image
        for name, tracker in trackers.items():
            unknown = np.full_like(frame.position, np.nan)
            estimate = MarkerEstimate(unknown, unknown, np.zeros(rows * cols, dtype=bool))
            try:
                if not failed[name]:
                    first = not truth
                    start = (frame.position, frame.visible, rows, cols)
                    estimate = tracker.start(image, *start) if first else tracker.track(image)
            except GelflowError as error:
                failed[name] = str(error)
            estimates[name].append(estimate)
        truth.append(frame.position)
        visible.append(frame.visible)
    at_rest = truth[0].reshape(rows, cols, 2)
    spacing = float(np.median(np.linalg.norm(np.diff(at_rest, axis=1), axis=-1)))
    return {
        name: TrackedSequence(
            position=np.array([one.position for one in series]),
            displacement=np.array([one.displacement for one in series]),
            valid=np.array([one.valid for one in series]),
            truth=np.array(truth),
            visible=np.array(visible),
            spacing=spacing,
            failed=failed[name],
        )
        for name, series in estimates.items()
    }
