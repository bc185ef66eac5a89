"""Readings of the pads from the shear forces of the markers: resampling, crosstalk, gain, rotation of the camera.

The markers that are printed on a gel are rarely those of a policy's grid. The gel then shows the forces at the printed
markers, which mix with their neighbours, and the runner interpolates the tracked vectors to the policy's grid. Both
interpolations are linear and smooth the edges of a contact, as crosstalk would.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from gelflow.geometry import rotated
from gelflow.observation import Grid, interpolation_weights, resampling_weights
from gelflow.sim.tasks.sensor_model import nearest_markers

Array = NDArray[np.float64]

SIDES = ("left", "right")
_NEIGHBOURS = 4


class PadModel:
    """The linear part of `SensorModel` on the printed markers, with derivatives.

    Parameters
    ----------
    grids: markers of each pad in the simulation and in the readings
    positions: of these markers, (markers, 2) or (markers, 3) of each pad
    printed: markers that are printed on each gel; None, or equal to `grids`: nothing is resampled
    """

    def __init__(self, grids: Sequence[Grid], positions: Sequence[Array], *, printed: Grid | None = None) -> None:
        self._grids = grids
        self._pad = np.repeat(np.arange(len(grids)), [len(pad) for pad in positions])
        self._neighbours = self._neighbours_on_grid = _nearest(positions)
        self._to_printed: Array | None = None
        self._to_grid: Array | None = None
        if printed is not None and any(grid != printed for grid in grids):
            self._to_printed = block_diag(*(interpolation_weights(grid, printed.positions()) for grid in grids))
            self._to_grid = block_diag(*(resampling_weights(printed.positions(), grid) for grid in grids))
            self._neighbours = _nearest([printed.positions()] * len(grids))

    def crosstalk_on_grid(self, crosstalk: Array) -> Array:
        """The crosstalk between markers of the policy's grid that is equivalent to `crosstalk` between printed markers.

        Equivalent means the same change of a field of constant curvature. The interpolations between both grids are
        included. Changes are medians, because neighbours are missing at the borders of the grid.
        """
        field = np.concatenate([(grid.positions() ** 2).sum(1) for grid in self._grids])[:, None]
        on_grid = np.median(field[self._neighbours_on_grid].mean(1) - field)
        least, full = (np.median(self._mixed(field, np.asarray(c)) - field) / on_grid for c in (0.0, 1.0))
        return np.asarray(least + (full - least) * np.asarray(crosstalk))

    def _on_print(self, shear: Array) -> Array:
        return shear if self._to_printed is None else np.asarray(self._to_printed @ shear)

    def _on_grid(self, vectors: Array) -> Array:
        return vectors if self._to_grid is None else np.asarray(self._to_grid @ vectors)

    def _exchange(self, printed: Array) -> Array:
        return np.asarray(printed[..., self._neighbours, :].mean(-2) - printed)

    def _mixed(self, shear: Array, crosstalk: Array) -> Array:
        printed = self._on_print(shear)
        return self._on_grid(printed + crosstalk * self._exchange(printed))

    def _seen(self, mixed: Array, values: Mapping[str, Array]) -> Array:
        gain, turn = (np.stack([values[f"{kind}_{side}"] for side in SIDES], -1)[..., self._pad]
                      for kind in ("gain", "turn"))  # fmt: skip
        return np.asarray(gain[..., None] * rotated(mixed, turn))

    def read(self, shear: Array, values: Mapping[str, Array]) -> Array:
        """Readings (…, markers, 2) of shear forces (…, markers, 2); each value has the shape of the leading axes."""
        return self._seen(self._mixed(shear, np.asarray(values["crosstalk"])[..., None, None]), values)

    def derivatives(self, shear: Array, values: Mapping[str, float]) -> dict[str, Array]:
        """Derivatives of the readings with respect to gains [per unit of gain], rotations [per rad] and crosstalk."""
        number = {key: np.asarray(value) for key, value in values.items()}
        reading = self.read(shear, number)
        result = {}
        for k, side in enumerate(SIDES):
            own = (self._pad == k)[:, None]
            result[f"gain_{side}"] = np.where(own, reading / values[f"gain_{side}"], 0.0)
            result[f"turn_{side}"] = np.where(own, np.stack([-reading[..., 1], reading[..., 0]], -1), 0.0)
        result["crosstalk"] = self._seen(self._on_grid(self._exchange(self._on_print(shear))), number)
        return result


def _nearest(positions: Sequence[Array]) -> NDArray[np.int64]:
    return nearest_markers(positions)[0][:, :_NEIGHBOURS]
