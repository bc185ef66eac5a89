"""How often the intervals of calibrations contain the truth, in random worlds that differ more than in training."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from gelflow.errors import GelflowError
from gelflow.policies.calibration.calibration import Calibration, calibrate
from gelflow.policies.calibration.experiment.worlds import record_world
from gelflow.policies.calibration.fit import FitSettings


def measure_coverage(
    seeds: Sequence[int],
    *,
    settings: FitSettings | None = None,
    processes: int = 1,
    measured: Sequence[dict[str, Any]] = (),
    progress: Callable[[dict[str, Any]], None] = lambda result: None,
) -> dict[str, Any]:
    """Calibrate from five insertions in the world of each seed; returns each world's results and the counts.

    A world counts as covered when every parameter that is reported as known lies in its interval. Worlds that cannot
    be recorded, because the gripper loses the part or no attempt has contact, are listed as refused. `measured` are the
    results of worlds that are not measured again; `progress` gets the result so far after each world.
    """
    known = {world["seed"]: world for world in measured}
    worlds: list[dict[str, Any]] = []
    for seed in seeds:
        worlds.append(known.get(seed) or _world(seed, settings, processes))
        progress(counted(worlds))
    return counted(worlds)


def counted(worlds: list[dict[str, Any]]) -> dict[str, Any]:
    """The counts of the results of worlds, and the results."""
    done = [world for world in worlds if "refused" not in world]
    known = [entry for world in done for entry in world["known"].values()]
    return {
        "worlds": len(done),
        "refused": len(worlds) - len(done),
        "covered_worlds": sum(world["covered"] for world in done),
        "known": len(known),
        "known_in_interval": sum(known),
        "results": worlds,
    }


def _world(seed: int, settings: FitSettings | None, processes: int) -> dict[str, Any]:
    try:
        world = record_world(seed)
        begun = time.process_time()
        result = calibrate(world.recordings, seed=seed, settings=settings, processes=processes)
    except GelflowError as error:
        return {"seed": seed, "refused": str(error)}
    return {
        "seed": seed,
        "attempts": len(world.recordings),
        **outcome(result, world.truth),
        "rms": float(np.sqrt((world.recordings.flow**2).mean())),
        "cpu_seconds": round(time.process_time() - begun, 1),
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
        "outside": [name for name, found in inside.items() if not found],
        "verdicts": verdicts,
        "starts": len(result.fit.starts),
        "residual": result.fit.best.chi,
        "held_out_residual": result.held_out_residual,
        "noise": result.noise,
        "held_out_before": None if held_out is None else held_out.error(held_out.before),
        "held_out_after": None if held_out is None else held_out.error(held_out.after),
    }
