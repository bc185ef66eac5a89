"""Displacement of the markers in the gels of a scene's pads."""

from typing import Any

import numpy as np

from gelflow.errors import UsageError
from gelflow.sim.arguments import number_array


def marker_displacement(scene: Any, forces: Any, dtype: Any) -> Any:
    """Displacement (…, markers, 3) under marker `forces` (…, markers, 3): an array, of `dtype`, or a tensor.

    See `Simulator.displacement`.
    """
    pads = getattr(scene, "pads", ())
    if not pads:
        raise UsageError("displacement needs a scene with pads")
    if without_gel := [pad.name for pad in pads if pad.gel is None]:
        raise UsageError(f"pad {without_gel[0]!r} has no gel; give pads.{without_gel[0]}.gel in the scene")
    if not hasattr(forces, "requires_grad"):
        forces = number_array("forces", forces, dtype)
    if forces.ndim < 2 or tuple(forces.shape[-2:]) != (scene.num_markers, 3):
        raise UsageError(f"forces must have shape (…, {scene.num_markers}, 3), got {tuple(forces.shape)}")
    displacements = [pad.gel.displacement(forces[..., scene.marker_slice(pad.name), :]) for pad in pads]
    if isinstance(forces, np.ndarray):
        return np.concatenate(displacements, axis=-2)
    import torch  # deferred: only tensors need torch

    return torch.cat(displacements, dim=-2)
