"""The loads on an elastic layer that explain the displacements of its markers.

Each marker has two measured displacements and its cell three loads, so the displacements alone do not determine the
loads: a pattern of normal loads and a matching pattern of shear displace the markers alike. The fit assumes properties
that contacts share:

- normal loads press (p ≥ 0);
- within a contact the shear follows one rigid motion: t = (a + ω × (x − c)) p + r, with a ratio a, a twist ω about
  the centre of pressure c, and a remainder r that is small, correlated between neighbours, and zero outside.

For given a and ω this is a linear least squares problem in p ≥ 0 and r; a and ω follow from Gauss-Newton steps. The
first fit of a contact tries several ratios, since the problem has several minima; the further ones begin with the
last result. Lengths are in pitches and loads in units of Young's modulus times the area of a cell. The steps are
computed in C++: `perception/csrc/force/contact_fit.hpp` states their equations.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from gelflow.gel.elastic_layer import square_cell_compliance
from gelflow.perception.force._contact_fit import (
    REMAINDER,
    REMAINDER_FLOOR,
    SMALLEST_LOAD,
    ContactFit,
    ContactFitter,
    NormalEquations,
)

Array = NDArray[np.float64]

_RATIOS = np.array([0.0, 0.1, 0.25, 0.5, 1.0])  # of shear to normal load, tried at the start of a contact
_CORRELATION = 1.0  # length over which r is alike [pitches]
_STEPS = 6  # of a first fit


class LayerModel:
    """Displacements of the markers of a regular grid under loads on their cells."""

    def __init__(self, rows: int, cols: int, poisson_ratio: float, thickness: float) -> None:
        """`thickness` in pitches."""
        self.markers = n = rows * cols
        blocks = square_cell_compliance(rows, cols, 1.0, poisson_ratio, thickness) * (1 + poisson_ratio) / np.pi
        xx, xy, yy, xz, yz, _ = blocks
        self.compliance = np.block([[xx, xy, xz], [xy, yy, yz]])  # (2n, 3n)
        row, col = np.divmod(np.arange(n), cols)
        self.position = np.stack([row - (rows - 1) / 2, col - (cols - 1) / 2], axis=1)
        distance = ((self.position[:, None] - self.position) ** 2).sum(-1)
        self.correlation = np.exp(-distance / (2 * _CORRELATION**2))
        self.smoothing = self.correlation / self.correlation.sum(1).max()
        neighbours = (np.abs(distance - 1) < 0.1).astype(float)
        self.roughness = np.diag(neighbours.sum(1) + 0.01) - neighbours
        self.fitter = ContactFitter(
            position=self.position,
            correlation=self.correlation,
            smoothing=self.smoothing,
            roughness=self.roughness,
            compliance=self.compliance,
        )
        self._gram_of_all = self.compliance.T @ self.compliance
        self._gram: tuple[bytes, Array] = (np.ones(n, bool).tobytes(), self._gram_of_all)

    def gram(self, valid: NDArray[np.bool_]) -> Array:
        """The product of the compliance of valid markers with itself, shape (3n, 3n)."""
        key = valid.tobytes()
        if self._gram[0] != key:
            rows = self.compliance[np.concatenate([~valid, ~valid])]
            self._gram = (key, self._gram_of_all - rows.T @ rows)
        return self._gram[1]


def fit_contact(
    model: LayerModel, displacement: Array, valid: NDArray[np.bool_], noise: float, start: ContactFit | None
) -> ContactFit:
    """Fit the loads to the displacements of one image.

    Parameters
    ----------
    displacement: [pitches], shape (n, 2); ignored where not valid
    noise: standard deviation of a displacement along one axis [pitches]
    start: the fit of the image before, None at the start of a contact
    """
    gram = model.gram(valid)
    image = model.fitter.equations(gram, displacement, valid, noise)
    if start is not None:
        return model.fitter.follow(image, start)
    fit = _first_fit(model, image, gram / noise**2, image.projected / noise**2)
    for _ in range(_STEPS):
        fit = model.fitter.step(image, fit)
    return fit


def _first_fit(model: LayerModel, image: NormalEquations, matrix: Array, right: Array) -> ContactFit:
    """The best of the fits without twist, with ratios along the shear that a linear estimate finds.

    `matrix` and `right` are the equations of the linear estimate without its prior.
    """
    n = model.markers
    precision = np.kron(np.eye(3), np.linalg.inv(model.correlation + 1e-4 * np.eye(n))) / (5 * SMALLEST_LOAD) ** 2
    factor = cho_factor(matrix + precision, lower=True, check_finite=False)
    shear = cho_solve(factor, right, check_finite=False)[: 2 * n].reshape(2, n)
    total = shear.sum(1)
    size = float(np.hypot(*total))
    direction = total / size if size > 0 else total
    lengths = np.hypot(*shear)
    cells = max(float(lengths.sum() ** 2 / max((lengths**2).sum(), 1e-30)), 20.0)
    weights = model.smoothing @ lengths
    ratios = _RATIOS if size > REMAINDER_FLOOR else _RATIOS[:1]
    return model.fitter.first(
        image,
        ratios=np.outer(ratios, direction),
        scales=np.maximum(size / np.maximum(ratios, 0.05) / cells, SMALLEST_LOAD),
        deviation=1.5 * REMAINDER * size / cells + REMAINDER_FLOOR * SMALLEST_LOAD,
        centre=weights @ model.position / max(float(weights.sum()), 1e-30),
    )
