"""Pickling and copying of a simulator: it is built again from its scene, and gets the state and the parameters."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim import _core
from gelflow.sim.state_arrays import STATE_ARRAYS


def contents(sim: Any, threads: int | None) -> tuple[Callable[..., Any], Any, dict[str, Any], dict[str, NDArray[Any]]]:
    """The arguments of `rebuilt`. Raises UsageError for a simulator of a core model, which has no description."""
    if isinstance(sim.scene, _core.Model):
        raise UsageError("a simulator of a core model cannot be pickled or copied; build it from a Scene")
    precision = "double" if sim.dtype is np.float64 else "single"
    options = {"num_envs": sim.num_envs, "threads": threads, "precision": precision}
    return type(sim), sim.scene, options, {name: getattr(sim, name).copy() for name in STATE_ARRAYS}


def rebuilt(build: Callable[..., Any], scene: Any, options: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Any:
    """A simulator of its own with the same state and parameters."""
    sim = build(scene, **options)
    for name, array in arrays.items():
        getattr(sim, name)[...] = array
    return sim
