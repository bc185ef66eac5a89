"""Readings of the pads from the shear forces of the markers: gain, rotation of the camera, and crosstalk."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from gelflow.geometry import rotated
from gelflow.sim.tasks.sensor_model import nearest_markers

Array = NDArray[np.float64]

SIDES = ("left", "right")
_NEIGHBOURS = 4


class PadModel:
    """The linear part of `SensorModel`, with derivatives.

    Parameters
    ----------
    positions: marker positions of each pad, (markers, 2) or (markers, 3)
    """

    def __init__(self, positions: Sequence[Array]) -> None:
        self._neighbours = nearest_markers(positions)[0][:, :_NEIGHBOURS]
        self._pad = np.repeat(np.arange(len(positions)), [len(pad) for pad in positions])

    def _mixed(self, shear: Array, crosstalk: Array) -> Array:
        near = shear[..., self._neighbours, :].mean(-2)
        return np.asarray(shear + crosstalk * (near - shear))

    def read(self, shear: Array, values: Mapping[str, Array]) -> Array:
        """Readings (…, markers, 2) of shear forces (…, markers, 2); each value has the shape of the leading axes."""
        gain, turn = (np.stack([values[f"{kind}_{side}"] for side in SIDES], -1)[..., self._pad]
                      for kind in ("gain", "turn"))  # fmt: skip
        mixed = self._mixed(shear, np.asarray(values["crosstalk"])[..., None, None])
        return np.asarray(gain[..., None] * rotated(mixed, turn))

    def derivatives(self, shear: Array, values: Mapping[str, float]) -> dict[str, Array]:
        """Derivatives of the readings with respect to gains [per unit of gain], rotations [per rad] and crosstalk."""
        number = {key: np.asarray(value) for key, value in values.items()}
        reading = self.read(shear, number)
        result = {}
        for k, side in enumerate(SIDES):
            own = (self._pad == k)[:, None]
            result[f"gain_{side}"] = np.where(own, reading / values[f"gain_{side}"], 0.0)
            result[f"turn_{side}"] = np.where(own, np.stack([-reading[..., 1], reading[..., 0]], -1), 0.0)
        change = shear[..., self._neighbours, :].mean(-2) - shear
        result["crosstalk"] = self.read(change, {**number, "crosstalk": np.asarray(0.0)})
        return result
