"""Estimate of a camera's constant latency from a grasp, which the gripper and the camera both measure."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gelflow.errors import UsageError

_RISE = 0.1  # of the final change: a signal above this has changed, one below half of it is at rest
_NOISE = 5.0  # a change also exceeds this many standard deviations of the noise
_BURST = 1e-3  # samples at most this far apart were received in a burst [s]
_VISIBLE = 0.5  # of the final change: largest threshold; a change whose noise needs a higher one is not visible


@dataclass(frozen=True)
class LatencyEstimate:
    """The interval [s] that contains the latency of a camera relative to the gripper."""

    low: float
    high: float

    @property
    def seconds(self) -> float:
        """The middle of the interval [s]."""
        return (self.low + self.high) / 2

    @property
    def uncertainty(self) -> float:
        """Half the width of the interval [s]."""
        return (self.high - self.low) / 2

    def __str__(self) -> str:
        return f"{1e3 * self.seconds:.0f} ± {1e3 * self.uncertainty:.0f} ms"


def estimate_latency(
    force_times: ArrayLike, force: ArrayLike, image_times: ArrayLike, marker_change: ArrayLike
) -> LatencyEstimate | None:
    """The latency that the stamps of a camera still contain, from one grasp; None when the grasp is not visible.

    `force` [N] is the gripper's measured force at `force_times` [s], `marker_change` [any unit] the mean length of the
    marker displacements at `image_times`, the stamps of the images [s]. Both series start before the contact, while the
    fingers close, and end when the force is reached.

    Each signal changes between two of its samples, so the result is an interval as wide as both sampling periods
    together: ±42 ms for images every 33 ms and gripper states every 50 ms. `combine_latencies` narrows it. A noise
    above 3 % of the change makes it less reliable. The delay of the gripper's own measurement counts as a negative
    latency of the camera. Samples that were received in a burst widen the interval. Add the result to the key `latency`
    of the camera in the lab file.

    Raises UsageError for series of different lengths or unordered times.
    """
    contact = _onset(force_times, force, "force")
    change = _onset(image_times, marker_change, "marker change")
    if contact is None or change is None:
        return None
    return LatencyEstimate(change[0] - contact[1], change[1] - contact[0])


def combine_latencies(estimates: Iterable[LatencyEstimate]) -> LatencyEstimate | None:
    """The interval common to the estimates of several grasps; None without estimates or when they contradict.

    A contradiction means that the latency varies.
    """
    known = list(estimates)
    low = max((estimate.low for estimate in known), default=1.0)
    high = min((estimate.high for estimate in known), default=0.0)
    return LatencyEstimate(low, high) if low <= high else None


def _onset(times: ArrayLike, values: ArrayLike, name: str) -> tuple[float, float] | None:
    """The interval [s] in which a signal starts to change; None when it does not change."""
    t, x = np.asarray(times, dtype=float), np.asarray(values, dtype=float)
    if t.ndim != 1 or t.shape != x.shape or (np.diff(t) < 0).any():
        raise UsageError(f"{name}: expected as many values as times, and times in ascending order")
    finite = np.isfinite(t) & np.isfinite(x)
    t, x = t[finite], x[finite]
    if t.size < 4:
        return None
    change = np.abs(x - np.median(x[: max(3, t.size // 8)]))
    final = float(np.quantile(change, 0.95))
    certain = int(np.argmax(change > _VISIBLE * final))
    if final <= 0 or certain < 3:
        return None
    noise = 1.4826 * float(np.median(np.abs(x[:certain] - np.median(x[:certain]))))
    level = max(_RISE * final, _NOISE * noise)
    at_rest = np.flatnonzero(change[:certain] <= level / 2)
    if level > _VISIBLE * final or at_rest.size == 0:
        return None
    start = int(at_rest[-1])
    end = start + int(np.argmax(change[start:] > level))
    first = float(_earliest(t)[start])
    # A rise that began just before the sample at `start` is within the noise there: extrapolate it back to zero.
    before = (t[end] - first) * change[start] / (change[end] - change[start])
    return float(first - before), float(t[end])


def _earliest(times: NDArray[np.float64]) -> NDArray[np.float64]:
    """The earliest times at which samples with these times of reception may have been measured [s].

    Samples in a burst were received late, because the receiver was stopped: they may be as old as the last sample that
    is as far from its neighbours as usual.
    """
    gaps = np.diff(times)
    usual = np.median(gaps[gaps > _BURST]) if (gaps > _BURST).any() else np.inf
    alone = np.concatenate([[True], gaps > usual / 2]) & np.concatenate([gaps > usual / 2, [True]])
    alone[0] = True
    last = np.maximum.accumulate(np.where(alone, np.arange(times.size), 0))
    return times[last]
