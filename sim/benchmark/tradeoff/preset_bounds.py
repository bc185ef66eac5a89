"""Error bounds of a scene's presets: measured over samples of the physics, tested on other samples."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gelflow.sim.benchmark.tradeoff.run import Errors, compare
from gelflow.sim.benchmark.tradeoff.sweep import reference, simulated
from gelflow.sim.scene import load_scene

MARGIN = 1.5  # bound relative to the largest measured error
SCENE_DEFAULT = "default"  # the scene's default settings, measured together with its presets


@dataclass(frozen=True)
class Bounds:
    """Errors of one preset over samples of the physics."""

    worst: Errors
    bound: Errors  # with the margin, two digits
    draws: int


def preset_errors(
    scene: str | Path,
    seeds: Sequence[int],
    *,
    halvings: int,
    presets: Sequence[str] | None = None,
    done: Callable[[float], None] = lambda _: None,
) -> dict[str, Errors]:
    """Largest errors of the scene's presets and default settings over samples of its physics.

    Parameters
    ----------
    scene: name of an included scene
    seeds: one sample each
    halvings: of a frame of 10 ms, for the reference
    presets: subset of the presets; None takes all
    done: called with the completed share
    """
    settings: Mapping[str, Mapping[str, Any]] = {SCENE_DEFAULT: {}, **load_scene(scene).presets}
    chosen = list(settings) if presets is None else presets
    worst: dict[str, Errors] = {}
    for at, seed in enumerate(seeds):
        exact = reference(scene, halvings, seed=seed)
        for name in chosen:
            errors = compare(simulated(scene, settings[name], seed=seed), exact)
            worst[name] = worst[name].worst(errors) if name in worst else errors
        done((at + 1) / len(seeds))
    return worst


def bounds(worst: Mapping[str, Errors], draws: int) -> dict[str, Bounds]:
    """Error bounds: the largest errors times `MARGIN`, rounded up to two digits; cosines to four."""
    result = {}
    for name, errors in worst.items():
        promised = {key: _up(MARGIN * value) for key, value in vars(errors).items() if key != "cosine"}
        promised["cosine"] = math.floor(1e4 * (1 - MARGIN * (1 - errors.cosine)) + 1e-6) / 1e4
        result[name] = Bounds(errors, Errors(**promised), draws)
    return result


def _up(value: float) -> float:
    """`value` rounded up to two digits."""
    if not 0 < value < math.inf:
        return max(value, 0.0)
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / unit - 1e-9) * unit:.2g}")
