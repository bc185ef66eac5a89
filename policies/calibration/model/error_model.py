"""Errors of flow maps that a fit allows for: noise of markers, error of the model, common shift of a pad."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gelflow.policies.calibration.recordings import MODEL_ERROR

Array = NDArray[np.float64]

# Standard deviation of a common shift of all markers of a pad between two readings [N]: that of each reading is up to
# 3e-3, three times the limit of the randomization.
DRIFT = 3e-3 * math.sqrt(2 / 3)  # until a fit estimates it
_LARGEST_DRIFT = 3e-3 * math.sqrt(2)
_CLUSTER = 9.0  # neighbouring markers that share the error of the model
_LEAST_VARIANCE = 1e-12  # of a marker [N²], where a flow map is zero
_HUBER = 3.0  # residuals beyond this many standard deviations count linearly


@dataclass(frozen=True)
class ErrorModel:
    """The errors of n flow maps with two pads, and the residuals and robust losses that follow from them."""

    noise: float  # standard deviation of the noise of a marker [N]
    rms: Array  # root mean square of the compared markers of each flow map [N], (n,)
    used: NDArray[np.bool_]  # markers that are compared, (all markers,)
    model_error: float = MODEL_ERROR  # relative to `rms`
    drift: float = DRIFT  # standard deviation of a common shift of all markers of a pad [N]

    @cached_property
    def markers(self) -> int:
        """Number of markers that are compared."""
        return int(self.used.sum())

    @cached_property
    def _of_model(self) -> Array:
        """Variance of the error of the model, (n,)."""
        return np.asarray((self.model_error * self.rms) ** 2)

    @cached_property
    def _variance(self) -> Array:
        """Variance of a marker without the common shift, (n,)."""
        return np.asarray(self.noise**2 + self._of_model + _LEAST_VARIANCE)

    @cached_property
    def _sigma(self) -> Array:
        return np.asarray(np.sqrt(self._variance))

    @cached_property
    def cluster_size(self) -> Array:
        """How many neighbouring markers count as one, (n,): 1 with noise only, `_CLUSTER` without noise."""
        return np.asarray((self.noise**2 + _CLUSTER * (self._of_model + _LEAST_VARIANCE)) / self._variance)

    @property
    def num_independent(self) -> Array:
        """Number of independent residuals of each flow map, (n,)."""
        return np.asarray(2 * self.markers / self.cluster_size)

    @cached_property
    def _shift_variance(self) -> Array:
        """Variance of the common shift of each pad relative to that of the mean of its markers, (n, pads)."""
        independent = self.used.reshape(2, -1).sum(1) / self.cluster_size[:, None]
        return np.asarray(independent * (self.drift / self._sigma[:, None]) ** 2)

    @cached_property
    def log_determinant(self) -> float:
        """Half the log-determinant of the covariance of all residuals, relative to that without a common shift."""
        return float(np.log1p(self._shift_variance).sum())  # half of it for each of two components

    def whiten(self, difference: Array, rows: NDArray[np.int64]) -> Array:
        """Residuals (m, 2 * markers) of differences (m, all markers, 2) [N] of the flow maps `rows`."""
        mean_fraction = 1 - 1 / np.sqrt(1 + self._shift_variance[rows])
        per_pad = difference.reshape(len(rows), 2, -1, 2)
        per_pad = per_pad - mean_fraction[:, :, None, None] * self._mean(per_pad)
        compared = per_pad.reshape(len(rows), -1, 2)[:, self.used]
        return np.asarray(compared.reshape(len(rows), -1) / self._sigma[rows][:, None])

    def misfit(self, residuals: Array, rows: NDArray[np.int64] | None = None) -> Array:
        """Robust loss (…, m) of residuals (…, m, k) of the flow maps `rows`, by default all."""
        cluster = self.cluster_size if rows is None else self.cluster_size[rows]
        return np.asarray(_huber(residuals).sum(-1) / cluster)

    def robust(self, residuals: Array) -> Array:
        """Values whose half squares add up to `misfit`, of residuals (…, n, k)."""
        return np.asarray(np.sign(residuals) * np.sqrt(2 * _huber(residuals) / self.cluster_size[:, None]))

    def weights(self, residuals: Array) -> Array:
        """Weights (n, k) of residuals in iteratively reweighted least squares."""
        return np.asarray(_huber_weights(residuals) / self.cluster_size[:, None])

    @staticmethod
    def chi(residuals: Array) -> float:
        """Robust root mean square of residuals: 1 as expected from these errors."""
        return float(np.sqrt((_huber_weights(residuals) * residuals**2).mean()))

    def estimated_drift(self, difference: Array) -> float:
        """`drift` from the differences (n, all markers, 2) [N] at the end of a fit, at most `_LARGEST_DRIFT`.

        The fit absorbs part of the shifts, so the variance is doubled.
        """
        mean = self._mean(difference.reshape(len(difference), 2, -1, 2))
        return min(_LARGEST_DRIFT, float(np.sqrt(2 * (mean**2).mean())))

    def _mean(self, per_pad: Array) -> Array:
        """Mean (m, pads, 1, 2) over the markers that are compared, of (m, pads, markers of a pad, 2)."""
        used = self.used.reshape(2, -1, 1)
        return np.asarray((used * per_pad).sum(2, keepdims=True) / used.sum(1, keepdims=True))


def _huber(residuals: Array) -> Array:
    """Half the square of residuals, linear beyond the limit."""
    size = np.abs(residuals)
    return np.where(size <= _HUBER, 0.5 * residuals**2, _HUBER * (size - 0.5 * _HUBER))


def _huber_weights(residuals: Array) -> Array:
    return np.asarray(np.minimum(1.0, _HUBER / np.maximum(np.abs(residuals), 1e-12)))
