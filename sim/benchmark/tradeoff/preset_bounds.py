"""How far off a scene's presets are at most: measured on physics drawn at random, tested on other draws."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gelflow.sim.benchmark.tradeoff.run import Errors, compare
from gelflow.sim.benchmark.tradeoff.sweep import reference, simulated
from gelflow.sim.scene import load_scene

MARGIN = 1.5  # a bound is this many times the worst that was measured
SCENE_DEFAULT = "default"  # the scene's own numbers, measured beside its presets


@dataclass(frozen=True)
class Bounds:
    """The errors of one preset over many draws."""

    worst: Errors
    bound: Errors  # with the margin, in two digits
    draws: int


def preset_errors(
    scene: str | Path,
    seeds: Sequence[int],
    *,
    halvings: int,
    presets: Sequence[str] | None = None,
    done: Callable[[float], None] = lambda _: None,
) -> dict[str, Errors]:
    """The worst errors of the scene's presets, and of its own numbers, over draws of its physics.

    Parameters
    ----------
    scene: name of a scene that comes along
    seeds: one draw each
    halvings: of a frame of 10 ms, for the reference
    presets: these only
    done: told the share that is done
    """
    ways: Mapping[str, Mapping[str, Any]] = {SCENE_DEFAULT: {}, **load_scene(scene).presets}
    chosen = list(ways) if presets is None else presets
    worst: dict[str, Errors] = {}
    for at, seed in enumerate(seeds):
        truth = reference(scene, halvings, seed=seed)
        for name in chosen:
            errors = compare(simulated(scene, ways[name], seed=seed), truth)
            worst[name] = worst[name].worst(errors) if name in worst else errors
        done((at + 1) / len(seeds))
    return worst


def bounds(worst: Mapping[str, Errors], draws: int) -> dict[str, Bounds]:
    """The errors that are promised: the worst ones with a margin, in two digits; a cosine in four."""
    found = {}
    for name, errors in worst.items():
        promised = {key: _up(MARGIN * value) for key, value in vars(errors).items() if key != "cosine"}
        promised["cosine"] = math.floor(1e4 * (1 - MARGIN * (1 - errors.cosine)) + 1e-6) / 1e4
        found[name] = Bounds(errors, Errors(**promised), draws)
    return found


def _up(value: float) -> float:
    """Two digits, rounded up."""
    if not 0 < value < math.inf:
        return max(value, 0.0)
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / unit - 1e-9) * unit:.2g}")
