"""How often the intervals of calibrations contain the truth, in random worlds that differ more than in training."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from rich.table import Table
from scipy.stats import chi2

from gelflow.errors import GelflowError
from gelflow.policies.calibration.calibration import Calibration, calibrate
from gelflow.policies.calibration.experiment.worlds import record_world
from gelflow.policies.calibration.fit import FitSettings


def counted(worlds: list[dict[str, Any]]) -> dict[str, Any]:
    """The counts of the results of worlds, and the results.

    A world counts as covered when every parameter that is reported as known lies in its interval. Worlds that cannot
    be recorded, because the gripper loses the part or no attempt has contact, count as refused. Trainings draw from the
    joint distributions of fits that converged, so only these can count as jointly covered.
    """
    done = [world for world in worlds if "refused" not in world]
    known = [entry for world in done for entry in world["known"].values()]
    return {
        "worlds": len(done),
        "refused": len(worlds) - len(done),
        "converged_worlds": sum(world["converged"] for world in done),
        "covered_worlds": sum(world["covered"] for world in done),
        "known": len(known),
        "known_in_interval": sum(known),
        "jointly_covered_worlds": sum(world["converged"] and world["jointly_covered"] for world in done),
        "results": worlds,
    }


def coverage_table(result: dict[str, Any]) -> Table:
    """The counts as a table."""
    columns = {
        "worlds": "worlds",
        "refused": "refused",
        "covered_worlds": "all known in their intervals",
        "known": "known parameters",
        "known_in_interval": "of these in the interval",
        "converged_worlds": "starts agree",
        "jointly_covered_worlds": "of these all in the joint region",
    }
    table = Table(*columns.values())
    table.add_row(*(str(result[key]) for key in columns))
    return table


def simulated_world(seed: int, *, settings: FitSettings | None = None, processes: int = 1) -> dict[str, Any]:
    """Calibrate from five insertions in the simulated world of a seed; its results, or why it was refused."""
    try:
        world = record_world(seed)
        result = calibrate(world.recordings, seed=seed, settings=settings, processes=processes)
    except GelflowError as error:
        return {"seed": seed, "refused": str(error)}
    return {
        "seed": seed,
        "attempts": len(world.recordings),
        **outcome(result, world.truth),
        "rms": float(np.sqrt((world.recordings.flow**2).mean())),
    }


def outcome(result: Calibration, truth: Mapping[str, float]) -> dict[str, Any]:
    """Verdicts and residuals of a calibration, and which of the parameters in `truth` lie in their intervals."""
    inside = {
        e.parameter.name: bool(e.low <= truth[e.parameter.name] <= e.high)
        for e in result.estimates
        if e.parameter.name in truth
    }
    verdicts = {e.parameter.name: e.verdict for e in result.estimates}
    known = {name: found for name, found in inside.items() if verdicts[name] == "known"}
    held_out = result.held_out
    return {
        "known": known,
        "covered": all(known.values()),
        "jointly_covered": _in_joint_region(result, truth),
        "outside": [name for name, found in inside.items() if not found],
        "verdicts": verdicts,
        "starts": len(result.fit.starts),
        "converged": result.converged,
        "residual": result.fit.best.chi,
        "held_out_residual": result.held_out_residual,
        "noise": result.noise,
        "held_out_before": None if held_out is None else held_out.error(held_out.before),
        "held_out_after": None if held_out is None else held_out.error(held_out.after),
    }


def _in_joint_region(result: Calibration, truth: Mapping[str, float]) -> bool:
    """Whether the parameters in `truth` are in the 95 % region of the joint distribution that a training draws from."""
    fitted = result.parameters
    given = [i for i, p in enumerate(fitted) if p.name in truth]
    mean, covariance = result.fit.joint_distribution
    error = np.array([float(fitted[i].whitened(np.array(truth[fitted[i].name]))) - mean[i] for i in given])
    return bool(error @ np.linalg.solve(covariance[np.ix_(given, given)], error) <= chi2.ppf(0.95, len(given)))
