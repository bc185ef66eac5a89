"""Readings of the pads from the shear forces of the markers: resampling, crosstalk, gain, rotation of the camera.

The markers that are printed on a gel are rarely those of a policy's grid. The gel then shows the forces at the printed
markers, which mix with their neighbours, and the runner interpolates the tracked vectors to the policy's grid. Both
interpolations are linear and smooth the edges of a contact, as crosstalk would.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_diag, csr_array, eye_array

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
        self._exchange_on_grid = _exchange(positions)
        # Readings without crosstalk, and their change per unit of crosstalk, as matrices.
        self._read, self._exchange = eye_array(len(self._pad), format="csr"), self._exchange_on_grid
        if printed is not None and any(grid != printed for grid in grids):
            on_print = printed.positions()
            to_printed = block_diag([interpolation_weights(grid, on_print) for grid in grids], format="csr")
            to_grid = block_diag([resampling_weights(on_print, grid) for grid in grids], format="csr")
            self._read = to_grid @ to_printed
            self._exchange = to_grid @ _exchange([on_print] * len(grids)) @ to_printed

    def crosstalk_on_grid(self, crosstalk: Array, flow: Array, used: NDArray[np.bool_]) -> Array:
        """The crosstalk between markers of the policy's grid that is equivalent to `crosstalk` between printed markers.

        Equivalent means, as nearly as possible, the same change of the flow maps `flow` (n, markers, 2) at the `used`
        markers (markers,), by least squares; between 0 and 1. The interpolations between both grids are included.
        """
        on_grid = _product(self._exchange_on_grid, flow)[:, used]
        changes = [(self._mixed(flow, np.asarray(c)) - flow)[:, used] for c in (0.0, 1.0)]
        least, full = (float(np.vdot(on_grid, change) / np.vdot(on_grid, on_grid)) for change in changes)
        return np.asarray(np.clip(least + (full - least) * np.asarray(crosstalk), 0.0, 1.0))

    def _mixed(self, shear: Array, crosstalk: Array) -> Array:
        return np.asarray(_product(self._read, shear) + crosstalk * _product(self._exchange, shear))

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
        result["crosstalk"] = self._seen(_product(self._exchange, shear), number)
        return result


def _exchange(positions: Sequence[Array]) -> csr_array:
    """The change of all markers per unit of crosstalk: the mean of the neighbours minus the marker, as a matrix."""
    neighbours = nearest_markers(positions)[0][:, :_NEIGHBOURS]
    markers, count = neighbours.shape
    rows = np.repeat(np.arange(markers), count)
    mean = csr_array((np.full(rows.size, 1 / count), (rows, neighbours.reshape(-1))), shape=(markers, markers))
    return csr_array(mean - eye_array(markers))


def _product(matrix: csr_array, vectors: Array) -> Array:
    """The product of a matrix (markers, markers) and vectors (…, markers, k)."""
    by_marker = np.moveaxis(vectors, -2, 0)
    product = matrix @ by_marker.reshape(len(by_marker), -1)
    return np.asarray(np.moveaxis(product.reshape(by_marker.shape), 0, -2))
