"""A calibration: parameters with intervals, errors on insertions that were not fitted, and what to record next."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.policies.calibration.comparison import error
from gelflow.policies.calibration.fit import FitResult, FitSettings, fit
from gelflow.policies.calibration.model.parameters import Parameter, gain_ratio
from gelflow.policies.calibration.model.shear_model import QUANTITIES
from gelflow.policies.calibration.planning.information import Known
from gelflow.policies.calibration.planning.suggestions import Suggestion, suggest
from gelflow.policies.calibration.pose_search import find_poses
from gelflow.policies.calibration.problem import Problem
from gelflow.policies.calibration.recordings import Recordings

Array = NDArray[np.float64]

FORMAT = 2  # of report.json
KNOWN, PARTLY = 0.3, 0.7  # largest width of an interval relative to that of the prior
REPRODUCED = 1.25  # largest residual of a fit relative to noise and model error; beyond it, intervals are not valid
ALLOWED_ERROR = 1.5  # largest error of held-out flow maps relative to the noise, up to which the model explains them
PREDICTED = 1.5  # largest residual of the held-out attempts relative to noise and model error
_HEIGHT_OFFSET = 1.5  # largest mean of the fitted start heights relative to their expected standard deviation
_CORRELATED = 0.8  # absolute correlation above which only the combination of two parameters is determined


@dataclass(frozen=True)
class Estimate:
    """One parameter with its 95 % interval."""

    parameter: Parameter
    value: float
    low: float
    high: float
    relative_width: float  # of the interval, relative to that of the prior
    confirmed: bool  # the fit is good enough for this parameter

    @property
    def verdict(self) -> str:
        """Whether the recordings determine the parameter: known, partly or unknown; unknown if the fit is poor."""
        if not self.confirmed:
            return "unknown"
        return "known" if self.relative_width < KNOWN else "partly" if self.relative_width < PARTLY else "unknown"


@dataclass(frozen=True)
class FlowMaps:
    """Recorded flow maps of n attempts, and simulated ones before and after the calibration, (n, markers, 2)."""

    recorded: Array
    before: Array
    after: Array
    names: tuple[str, ...]  # of the attempts, (n,)
    used: NDArray[np.bool_]  # markers that are compared (markers,)

    def error(self, simulated: Array) -> float:
        """Root mean square difference of a component of a marker vector that is compared."""
        return error(self.recorded, simulated, self.used)


@dataclass(frozen=True)
class Calibration:
    """Result of `calibrate`. Flow maps and noise are in `unit`."""

    estimates: tuple[Estimate, ...]
    correlated: tuple[tuple[str, str, float], ...]  # two parameters and their correlation, if large
    fitted: FlowMaps
    held_out: FlowMaps | None  # None: there was one insertion only
    held_out_residual: float | None  # root mean square of their whitened residuals after the calibration
    recordings: Recordings  # all of them
    suggestions: tuple[Suggestion, ...]
    fit: FitResult

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The fitted parameters, in the order of their whitened values; `estimates` has the ratio of the gains too."""
        return tuple(estimate.parameter for estimate in self.estimates[: self.fit.count])

    @property
    def noise(self) -> float:
        """Standard deviation of the difference of two readings of a marker."""
        return self.recordings.noise()

    @property
    def unit(self) -> str:
        """Unit of the flow maps and the noise."""
        return self.recordings.unit

    @property
    def reproduced(self) -> bool:
        """Whether the fit reproduces the recordings to within the noise and the expected error of the model."""
        return _reproduced(self.fit)

    @property
    def converged(self) -> bool:
        """Whether more than half of the starts of the fit end in fits about as good as the best one."""
        return self.fit.converged

    @property
    def predicted(self) -> bool | None:
        """Whether the residual of the held-out attempts is at most `PREDICTED`; None: none held out.

        A fit that ends in a wrong minimum may reproduce the recordings as well, because the fitted poses of their
        insertions compensate wrong forces. The pose of an insertion that was not fitted does not.
        """
        return _predicted(self.held_out_residual)

    @property
    def known(self) -> Known | None:
        """Distribution of the parameters that plans start from; None: the priors, since the fit is not good enough."""
        return _known(self.estimates, self.fit)

    @property
    def explained(self) -> bool | None:
        """Whether the errors of held-out flow maps are at most `ALLOWED_ERROR` times the noise; None: none held out."""
        maps = self.held_out
        return None if maps is None else maps.error(maps.after) <= ALLOWED_ERROR * self.noise

    @property
    def height_offset(self) -> float:
        """Mean of the fitted start heights of the attempts, above that by the lab file [m]."""
        return float(self.recordings.height_spread * self.fit.best.point[self.fit.count :].mean())

    @property
    def height_plausible(self) -> bool:
        """Whether `height_offset` is within what is expected of single attempts."""
        return abs(self.height_offset) <= _HEIGHT_OFFSET * self.recordings.height_spread

    def not_modelled(self) -> str:
        """One line about the difference between held-out and simulated flow maps beyond the noise."""
        maps = self.held_out
        if maps is None or self.explained:
            return ""
        rest = np.where(maps.used[:, None], maps.after - maps.recorded, np.nan)
        sides = rest.reshape(len(rest), 2, -1, 2)
        power = np.nanmean(sides**2, (0, 2))
        shift = float((np.nanmean(sides, 2) ** 2).mean() / np.nanmean(sides**2))
        side, axis = np.unravel_index(int(power.argmax()), power.shape)
        times = maps.error(maps.after) / max(self.noise, 1e-30)
        return (
            f"not modelled: held-out flow maps differ by {times:.1f} times the noise; {100 * shift:.0f} % of this is a "
            f"common shift of all markers of a pad; the largest part is on the {('left', 'right')[side]} pad along "
            f"{'xy'[axis]}"
        )


def calibrate(
    recordings: Recordings,
    *,
    seed: int = 0,
    settings: FitSettings | None = None,
    processes: int = 1,
    hold_out: bool = True,
    progress: Callable[[int], None] = lambda done: None,
) -> Calibration:
    """Fit the simulator to recordings; with `hold_out` the last insertion is held out if there are several.

    Raises UsageError without attempts, SimulationError when no start can be simulated.
    """
    insertions = np.unique(recordings.insertion)
    hold_out = hold_out and len(insertions) > 1
    training = recordings.of(insertions[:-1]) if hold_out else recordings
    result = fit(training, seed=seed, settings=settings, processes=processes, progress=progress)
    problem = Problem(training)
    problem.allow_for(drift=result.best.drift)
    rng = np.random.default_rng((seed, 0xCA1))
    point = result.best.point[: result.count]
    held_out, residual = None, None
    if hold_out:
        other = Problem(recordings.of(insertions[-1:]))
        other.allow_for(drift=result.best.drift)
        found = find_poses(other, point, rng)
        held_out, residual = _flow_maps(other, found, rng), other.errors.chi(other.residuals(*found)[0])
    estimates = _estimates(problem.fitted, result, predicted=_predicted(residual) is not False)
    return Calibration(
        estimates,
        _pairs(problem.fitted, result),
        _flow_maps(problem, (result.best.point, result.best.misalignment), rng),
        held_out,
        residual,
        recordings,
        tuple(suggest(problem, _known(estimates, result))),
        result,
    )


def _reproduced(result: FitResult) -> bool:
    return result.best.chi <= REPRODUCED


def _predicted(residual: float | None) -> bool | None:
    return None if residual is None else residual <= PREDICTED


def _estimates(fitted: tuple[Parameter, ...], result: FitResult, *, predicted: bool) -> tuple[Estimate, ...]:
    """Estimates of the parameters, and of the ratio of the gains, which may be known although neither gain is.

    None is confirmed unless the fit converged and reproduces the recordings. The parameters of the simulator are
    confirmed only if the held-out insertion is predicted too: gains, rotations and crosstalk are differences between
    pads and between markers, which a wrong force hardly changes.
    """
    ratio, of_ratio = gain_ratio(fitted)
    directions = np.vstack([np.eye(len(fitted)), of_ratio])
    low, high = result.interval(directions)
    best = directions @ result.best.point[: result.count]
    return tuple(
        Estimate(
            p,
            float(p.value(best[i])),
            float(p.value(low[i])),
            float(p.value(high[i])),
            float((high[i] - low[i]) / (2 * 1.96)),
            result.converged and _reproduced(result) and (predicted or p.name not in QUANTITIES),
        )
        for i, p in enumerate((*fitted, ratio))
    )


def _known(estimates: Sequence[Estimate], result: FitResult) -> Known | None:
    """The joint distribution of the confirmed parameters, with the priors of the others; None: none is confirmed."""
    unknown = np.array([not estimate.confirmed for estimate in estimates[: result.count]])
    if unknown.all():
        return None
    mean, covariance = result.joint_distribution
    covariance = np.where(unknown[:, None] | unknown, np.eye(result.count), covariance)
    return Known(np.where(unknown, 0.0, mean), covariance, result.best.drift)


def _pairs(fitted: tuple[Parameter, ...], result: FitResult) -> tuple[tuple[str, str, float], ...]:
    spread = np.sqrt(np.diag(result.covariance))
    correlation = result.covariance / np.outer(spread, spread)
    found = [
        (fitted[i].name, fitted[j].name, float(correlation[i, j]))
        for i in range(len(fitted))
        for j in range(i + 1, len(fitted))
        if abs(correlation[i, j]) > _CORRELATED
    ]
    return tuple(sorted(found, key=lambda pair: -abs(pair[2])))


def _flow_maps(problem: Problem, after: tuple[Array, Array], rng: np.random.Generator) -> FlowMaps:
    """Recorded flow maps, and simulated ones with the scene's values and with those of `after`: a point and its poses.

    With the scene's values, the poses and start heights are searched, from one start because they explain little.
    """
    before = find_poses(problem, problem.scene_point(), rng, starts=1)
    recorded = problem.recorded_flow()
    return FlowMaps(
        recorded, problem.flow(*before), problem.flow(*after), problem.recordings.names, problem.errors.used
    )
