"""Random worlds: most differ from training in one to three groups of values, within what a lab may have."""

import dataclasses
import random
from typing import Any

from gelflow.hardware_mocks.simulated_cell.world import World, world_from_tables

_AS_TRAINED = 0.3  # fraction of the worlds that equal training

# Group of values → key → (low, high), uniform
_RANGES: dict[str, dict[str, tuple[float, float]]] = {
    "friction": {"pads": (0.5, 2.0), "hole": (0.3, 1.5)},
    "gels": {"left": (0.4, 5.0), "right": (0.4, 5.0)},
    "hole": {"stiffness": (0.5, 5.0)},
    "taught_error": {"x": (-1e-3, 1e-3), "y": (-1e-3, 1e-3), "z": (-3e-3, 3e-3), "yaw_deg": (-2.0, 2.0)},
    "markers": {"jitter_mm": (0.0, 0.04), "missing": (0.0, 0.03)},
    "cameras": {"noise": (0.5, 3.0), "blur_px": (0.8, 2.0), "light": (90.0, 150.0), "rate": (20.0, 40.0)},
    "arm": {"lag": (0.004, 0.025), "stiffness": (3e4, 3e5)},
    "part": {"mass": (0.04, 0.15)},
    "sensor": {"creep": (0.0, 0.3), "crosstalk": (0.0, 0.2), "gain_spread": (0.0, 0.08), "drift_mm": (0.0, 0.05)},
    "lens": {"tilt": (-8.0, 8.0), "barrel": (-0.02, 0.06)},
}


def random_world(seed: int) -> World:
    """The world of a seed. Equal seeds give equal worlds."""
    rng = random.Random(f"world {seed}")
    if rng.random() < _AS_TRAINED:
        return World()
    tables: dict[str, Any] = {}
    for group in rng.sample(sorted(_RANGES), rng.randint(1, 3)):
        values = {key: float(f"{rng.uniform(*limits):.4g}") for key, limits in _RANGES[group].items()}
        if group == "gels" and rng.random() < 0.7:
            values["right"] = values["left"]  # gels of one batch
        if group == "lens":
            lens = {"tilt_deg": [values["tilt"], 0.0], "barrel": values["barrel"]}
            tables["cameras"] = {**tables.get("cameras", {}), **lens}
        else:
            tables[group] = {**tables.get(group, {}), **values}
    if "hole" in tables:
        clearance = float(f"{rng.uniform(3e-3, 6e-3):.3g}")
        tables["hole"]["clearance"] = [clearance, clearance]
    return world_from_tables(tables, f"random world {seed}")


def changed_groups(world: World) -> list[str]:
    """Names of the groups of values in which a world differs from training."""
    default = World()
    names = [item.name for item in dataclasses.fields(World)]
    return [name for name in names if getattr(world, name) != getattr(default, name)]
