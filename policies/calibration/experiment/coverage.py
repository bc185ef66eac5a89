"""How often the intervals of calibrations contain the truth, in random worlds that differ more than in training."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from gelflow.errors import GelflowError
from gelflow.policies.calibration.calibration import calibrate
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
        progress(_counted(worlds))
    return _counted(worlds)


def _counted(worlds: list[dict[str, Any]]) -> dict[str, Any]:
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
    known = {
        e.parameter.name: bool(e.low <= world.truth[e.parameter.name] <= e.high)
        for e in result.estimates
        if e.verdict == "known"
    }
    all_in = {e.parameter.name: bool(e.low <= world.truth[e.parameter.name] <= e.high) for e in result.estimates}
    held_out = result.held_out
    return {
        "seed": seed,
        "attempts": len(world.recordings),
        "known": known,
        "covered": all(known.values()),
        "outside": [name for name, inside in all_in.items() if not inside],
        "verdicts": {e.parameter.name: e.verdict for e in result.estimates},
        "starts": len(result.fit.starts),
        "residual": result.fit.best.chi,
        "held_out_residual": result.held_out_residual,
        "noise": result.noise,
        "held_out_before": None if held_out is None else held_out.error(held_out.before),
        "held_out_after": None if held_out is None else held_out.error(held_out.after),
        "rms": float(np.sqrt((world.recordings.flow**2).mean())),
        "cpu_seconds": round(time.process_time() - begun, 1),
    }
