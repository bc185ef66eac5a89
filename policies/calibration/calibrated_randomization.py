"""The randomization of a training that follows a calibration: what its recordings leave open.

Hardly any parameter of a lab is known alone: markers that are stiff on a sensor with low gain give the flow maps of
soft ones on a sensor with high gain. Combinations are known far better. A training therefore draws all parameters
together, from samples of the joint distribution in which the fit ends.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.policies.calibration.calibration import FORMAT, Calibration
from gelflow.policies.calibration.model.parameters import gain_ratio
from gelflow.policies.calibration.model.reading_model import ReadingModel, unit_per_newton
from gelflow.policies.calibration.model.shear_model import QUANTITIES
from gelflow.sim.tasks.insertion import insertion_scene
from gelflow.sim.tasks.insertion_randomization import DEFAULT_RANDOMIZATION
from gelflow.task import InsertionTask

Array = NDArray[np.float64]

SAMPLES = 256
_DRAWS = 64 * SAMPLES  # points from the joint distribution; the first `SAMPLES` within the limits are used
_LIMIT = 3**0.5  # of a whitened parameter [sd]: three times the range of a randomization that is the prior
_NOISE = 2.0  # factor by which the estimate of the noise may be wrong
_DIGITS = 5  # significant
_SIGNED = ("grasp_height", "turn_left", "turn_right")
_POSITIVE = (*QUANTITIES, "gain_ratio")  # except the signed ones; the others may be zero


def calibrated_randomization(result: Calibration) -> dict[str, Any]:
    """Options of `make_task`: `ranges` of noise and stop shear, and `samples` of the confirmed parameters.

    Both are empty when the fit does not converge or does not reproduce the recordings. When it does not predict the
    held-out insertion, the samples are those of the sensors alone.
    """
    if not (result.converged and result.reproduced):
        return {"ranges": {}, "samples": {}}
    recordings = result.recordings
    scale = unit_per_newton(recordings.unit, insertion_scene(recordings.task))
    ranges = {"noise": _rounded(np.array([1 / _NOISE, _NOISE]) * recordings.noise() / np.sqrt(2) / scale)}
    if (stops := recordings.stop_shear()) is not None:
        ranges["stop_shear"] = _rounded(np.array(stops) / scale)
    samples = {name: _rounded(values) for name, values in _samples(result, np.random.default_rng(0)).items()}
    return {"ranges": ranges, "samples": samples}


def _samples(result: Calibration, rng: np.random.Generator) -> dict[str, Array]:
    """Quantity of the randomization → samples (n,), of the parameters that the fit is good enough for.

    The gain of both pads, which the randomization does not have, multiplies the stiffnesses of their markers. Its
    crosstalk is that between the markers of the policy, not the printed ones.
    """
    confirmed = {e.parameter.name for e in result.estimates if e.confirmed}
    fitted = result.parameters
    of_table = [p.name in QUANTITIES and not p.name.startswith("grasp") for p in fitted]
    mean = result.fit.joint_distribution[0]
    points = _within(np.where(of_table, _LIMIT, np.abs(mean) + _LIMIT), result.fit.draw(rng, _DRAWS))
    values = {p.name: p.value(points[:, i]) for i, p in enumerate(fitted)}
    ratio, direction = gain_ratio(fitted)
    values[ratio.name] = ratio.value(points @ direction)
    gain = np.sqrt(values["gain_left"] * values["gain_right"])
    values |= {name: values[name] * gain for name in ("marker_kn", "marker_ks")}
    recordings = result.recordings
    flow = recordings.flow.reshape(len(recordings), -1, 2)
    pads = ReadingModel(recordings, threads=1).pads
    values["crosstalk"] = pads.crosstalk_on_grid(values["crosstalk"], flow, recordings.used)
    return {name: values[name] for name in DEFAULT_RANDOMIZATION if name in values and name in confirmed}


def _within(limit: Array, points: Array) -> Array:
    """The first `SAMPLES` of the points (n, parameters) that are within ± `limit` (parameters,).

    Where there are fewer, the nearest other points are moved to the limit, which changes combinations of parameters.
    """
    beyond = np.maximum(np.abs(points) - limit, 0.0).max(1)
    return np.clip(points[np.argsort(beyond, kind="stable")[:SAMPLES]], -limit, limit)


def _rounded(values: Array) -> list[float]:
    return [float(f"{value:.{_DIGITS}g}") for value in values]


def read_randomization(path: Path, task: InsertionTask) -> dict[str, Any]:
    """The options of `make_task` in the file `report.json` of a calibration, for a training of `task`.

    The grasp height is omitted when the task has another part than the calibrated one. Raises UsageError when the file
    is no such report, has another format, or its recordings determine nothing.
    """
    try:
        report: Any = json.loads(path.read_text("utf-8"))
        number = report["format"]
        if number == FORMAT:
            part, found = report["part"], report["randomization"]
            options: dict[str, Any] = {
                "ranges": {str(name): _numbers([low, high]) for name, (low, high) in found["ranges"].items()},
                "samples": {str(name): _numbers(values) for name, values in found["samples"].items()},
            }
            maps = dict(report.get("flow_maps", {}))
    except OSError as error:
        raise UsageError(f"cannot read the calibration {path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError, ArithmeticError, RecursionError):
        raise UsageError(f"{path} is not the report.json of gelflow calibrate") from None
    if number != FORMAT:
        raise UsageError(f"{path}: format must be {FORMAT}, got {number!r}; repeat gelflow calibrate")
    if part != task.part.to_json():
        options["samples"].pop("grasp_height", None)
    if not options["samples"]:
        raise UsageError(f"{path}: {_why_nothing(maps)}; see record_next there")
    try:
        DEFAULT_RANDOMIZATION.replace(**options["ranges"]).drawn_from(options["samples"])
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from None
    for name, values in options["samples"].items():
        if name not in _SIGNED and (min(values) < 0 or (min(values) == 0 and name in _POSITIVE)):
            raise UsageError(f"{path}: samples of {name} must be positive, got {min(values):g}")
    return options


def _why_nothing(flow_maps: Any) -> str:
    """Why a report with these results for its flow maps has no samples."""
    if not flow_maps.get("converged", True):
        return "the starts of the fit do not agree"
    if not flow_maps.get("reproduced", True):
        return "the simulation with the fitted parameters does not reproduce the recordings"
    return "the recordings determine nothing about the randomization"


def _numbers(values: Any) -> list[float]:
    """A list of JSON numbers; raises TypeError for anything else."""
    if not isinstance(values, list) or any(isinstance(v, bool) or not isinstance(v, int | float) for v in values):
        raise TypeError(values)
    return [float(value) for value in values]
