"""Intervals from planned attempts, compared with those from insertions of the included policy in the same worlds."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import GelflowError
from gelflow.policies.calibration.calibration import calibrate
from gelflow.policies.calibration.experiment.worlds import RecordedWorld, record_world
from gelflow.policies.calibration.fit import FitSettings
from gelflow.policies.calibration.model.reading_model import ReadingModel
from gelflow.policies.calibration.planning.information import Attempts, information, pose_prior, without_pose
from gelflow.policies.calibration.session_recordings import AT_REST
from gelflow.session.motion_plan import PlannedMotion

Array = NDArray[np.float64]


def measure_plan(
    seeds: Sequence[int],
    plan: Sequence[PlannedMotion],
    *,
    settings: FitSettings | None = None,
    fits: int = 0,
    processes: int = 1,
    progress: Callable[[dict[str, Any]], None] = lambda world: None,
) -> dict[str, Any]:
    """Widths of the intervals from a plan and from five insertions, two attempts of each, in the worlds of seeds.

    `expected` are the widths at the true parameters, from the Fisher information; `expected_half` are the same, with
    only one attempt of each of the five insertions. In the first `fits` worlds, `fitted` are the widths of calibrations
    without held-out attempts. A width is relative to that of the prior. `ratio` of a world is the geometric mean of the
    widths from the plan over that from the insertions: at most 1 where the plan gives the same or narrower intervals.
    """
    worlds: list[dict[str, Any]] = []
    for seed in seeds:
        fit = sum("fitted" in world for world in worlds) < fits
        worlds.append(_world(seed, plan, settings if fit else None, fit, processes))
        progress(worlds[-1])
    result: dict[str, Any] = {"refused": sum("refused" in world for world in worlds)}
    for key in ("expected", "expected_half", "fitted"):
        found = [world for world in worlds if key in world]
        if found:
            result[key] = {
                "worlds": len(found),
                "same_or_narrower": sum(world[key]["ratio"] <= 1 for world in found),
                "mean_ratio": float(np.exp(np.mean([np.log(world[key]["ratio"]) for world in found]))),
                "motions_planned": float(np.mean([world["motions_planned"] for world in found])),
                "motions_unplanned": float(np.mean([world["motions_unplanned"] for world in found])),
            }
    return result | {"results": worlds}


def _world(
    seed: int, plan: Sequence[PlannedMotion], settings: FitSettings | None, fit: bool, processes: int
) -> dict[str, Any]:
    try:
        unplanned, planned = record_world(seed), record_world(seed, plan=plan)
        result: dict[str, Any] = {
            "seed": seed,
            "motions_planned": len(planned.recordings),
            "motions_unplanned": len(unplanned.recordings),
            "expected": _compared(expected_widths(planned), expected_widths(unplanned)),
            "expected_half": _compared(expected_widths(planned), expected_widths(unplanned, attempts=1)),
        }
        if fit:
            fitted = [
                {
                    e.parameter.name: e.relative_width
                    for e in calibrate(
                        world.recordings, seed=seed, settings=settings, processes=processes, hold_out=False
                    ).estimates
                }
                for world in (planned, unplanned)
            ]
            result["fitted"] = _compared(*fitted)
    except GelflowError as error:
        return {"seed": seed, "refused": str(error)}
    return result


def _compared(planned: dict[str, float], unplanned: dict[str, float]) -> dict[str, Any]:
    ratio = np.exp(np.mean([np.log(planned[name] / unplanned[name]) for name in planned]))
    return {"ratio": float(ratio), "planned": planned, "unplanned": unplanned}


def expected_widths(world: RecordedWorld, *, attempts: int | None = None) -> dict[str, float]:
    """Parameter → width of its interval relative to that of the prior, from the information at the true values.

    Readings are taken at rest, as on the robot. `attempts` limits the attempts of each insertion that count.
    """
    recordings = dataclasses.replace(world.recordings, settle=AT_REST)
    readings = ReadingModel(recordings)
    point = np.array([float(p.whitened(np.array(world.truth[p.name]))) for p in readings.fitted])
    misalignment = world.misalignment[recordings.insertion]
    attempts_made = Attempts(misalignment, recordings.planar_pose, world.heights, recordings.depth)
    each = information(readings, point, attempts_made, recordings.noise() / readings.scale, used=recordings.used)
    total = np.eye(len(readings.fitted))
    for insertion in np.unique(recordings.insertion):
        of_part = each[recordings.insertion == insertion][:attempts].sum(0)
        total = total + without_pose(of_part, pose_prior(recordings.task))
    widths = np.sqrt(np.diag(np.linalg.inv(total)))
    return {p.name: float(width) for p, width in zip(readings.fitted, widths, strict=True)}
