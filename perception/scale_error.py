"""Uncertainty of a camera's local scale that follows from an uneven print.

The residuals of a calibration have a random part, by which each dot is misplaced on the gel, and possibly a smooth
part, which changes slowly over the image. The random part moves the fit. The smooth part may be a stretched print, a
touched gel, or a lens that the model does not describe; its gradient is then the relative error of lengths.
"""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_SMOOTH_DEGREES = (2, 3, 4)  # of the polynomials that may describe the smooth part
_EVIDENCE = 10.0  # decrease of the Bayesian information criterion that shows a smooth part
_NO_RESIDUAL = 1e-9  # [spacings]


def scale_error(nodes: Floats, residual: Floats, *, degree: int) -> tuple[float, float]:
    """Relative standard deviation of a length on the gel, and the share of the residuals' variance that is smooth.

    Parameters
    ----------
    nodes: fitted grid positions of the markers [spacings], shape (n, 2)
    residual: measured minus fitted positions [spacings], shape (n, 2)
    degree: of a polynomial with about as many coefficients as the fitted mapping, 2 without and 3 with lens distortion
    """
    extent = np.ptp(nodes, axis=0).max() / 2
    at = (nodes - nodes.mean(axis=0)) / extent
    variance = float((residual**2).sum()) / max(2 * len(nodes) - 2 * _count(degree), 1)
    smooth, mean_square, slope = 0.0, max(float((residual**2).mean()), _NO_RESIDUAL**2), 0.0
    best = _criterion(mean_square, len(nodes), 0)
    for higher in _SMOOTH_DEGREES:
        if 2 * _count(higher) > len(nodes):
            break
        terms, along = _terms(at, higher), _slopes(at, higher)
        weights = np.linalg.lstsq(terms, residual, rcond=None)[0]
        unexplained = max(float(((residual - terms @ weights) ** 2).mean()), _NO_RESIDUAL**2)
        if _criterion(unexplained, len(nodes), 2 * _count(higher)) < best - _EVIDENCE:
            best = _criterion(unexplained, len(nodes), 2 * _count(higher))
            smooth, variance = 1 - unexplained / mean_square, unexplained
            slope = float(np.mean([(part @ weights) ** 2 for part in along]))
    inverse = np.linalg.pinv(_terms(at, degree).T @ _terms(at, degree))
    random = variance * float(np.mean([np.einsum("ni,ij,nj->n", part, inverse, part) for part in _slopes(at, degree)]))
    return float(np.sqrt(slope + random) / extent), smooth


def _count(degree: int) -> int:
    """Number of coefficients of a polynomial in two variables."""
    return (degree + 1) * (degree + 2) // 2


def _powers(degree: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]


def _terms(at: Floats, degree: int) -> Floats:
    return np.stack([at[:, 0] ** i * at[:, 1] ** j for i, j in _powers(degree)], axis=1)


def _slopes(at: Floats, degree: int) -> tuple[Floats, Floats]:
    """Derivatives of the terms by both coordinates."""
    x, y = at.T
    right = [i * x ** max(i - 1, 0) * y**j for i, j in _powers(degree)]
    down = [j * x**i * y ** max(j - 1, 0) for i, j in _powers(degree)]
    return np.stack(right, axis=1), np.stack(down, axis=1)


def _criterion(variance: float, markers: int, parameters: int) -> float:
    """Bayesian information criterion of residuals in two coordinates."""
    return float(2 * markers * np.log(variance) + parameters * np.log(2 * markers))
