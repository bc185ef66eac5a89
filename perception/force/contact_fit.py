"""The loads on an elastic layer that explain the displacements of its markers.

Each marker has two measured displacements and its cell three loads, so the displacements alone do not determine the
loads: a pattern of normal loads and a matching pattern of shear displace the markers alike. The fit assumes properties
that contacts share:

- normal loads press (p ≥ 0);
- within a contact the shear follows one rigid motion: t = (a + ω × (x − c)) p + r, with a ratio a, a twist ω about
  the centre of pressure c, and a remainder r that is small, correlated between neighbours, and zero outside.

For given a and ω this is a linear least squares problem in p ≥ 0 and r; a and ω follow from Gauss-Newton steps. The
first fit of a contact tries several ratios, since the problem has several minima; the further ones begin with the
last result. Lengths are in pitches and loads in units of Young's modulus times the area of a cell.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, lapack

from gelflow.gel.elastic_layer import square_cell_compliance
from gelflow.perception.force.nonnegative import solve_nonnegative, solve_positive_definite

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_RATIOS = (0.0, 0.1, 0.25, 0.5, 1.0)  # of shear to normal load, tried at the start of a contact
_RATIO_DEVIATION = 1.0  # prior of a
_TWIST_DEVIATION = 0.5  # prior of ω, per pitch
_REMAINDER = 0.15  # r relative to the shear of the rigid motion
_SMALLEST_LOAD = 0.03  # scale of the load of a cell where nothing is known
_REMAINDER_FLOOR = 0.06
_CORRELATION = 1.0  # length over which r is alike [pitches]
_LOAD_PRIOR = 0.003 * 16  # weight of differences between neighbouring normal loads, relative to the largest ones
_STEPS = 6  # of a first fit
_LARGEST_CHANGE = 0.3  # of a in one step
_CONVERGED = 0.05  # change of the ratios of shear to normal load, below which no further step follows
_RIGID_PRIOR = np.array([_RATIO_DEVIATION, _RATIO_DEVIATION, _TWIST_DEVIATION]) ** -2.0


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
        self._gram_of_all = self.compliance.T @ self.compliance
        self._gram: tuple[bytes, Array] = (np.ones(n, bool).tobytes(), self._gram_of_all)
        self._precision: tuple[bytes, Array] = (b"", np.empty(0))

    def gram(self, valid: NDArray[np.bool_]) -> Array:
        """The product of the compliance of valid markers with itself, shape (3n, 3n)."""
        key = valid.tobytes()
        if self._gram[0] != key:
            rows = self.compliance[np.concatenate([~valid, ~valid])]
            self._gram = (key, self._gram_of_all - rows.T @ rows)
        return self._gram[1]

    def precision(self, cells: Indices) -> Array:
        """Inverse of the correlation of the remainder at `cells`; only the triangle above the diagonal is set."""
        key = cells.tobytes()
        if self._precision[0] != key:
            correlation = self.correlation.take(cells, 0).take(cells, 1)
            correlation[np.diag_indices(cells.size)] += 0.01
            inverse, _ = lapack.dpotri(_cholesky(correlation), lower=1, overwrite_c=1)
            self._precision = (key, inverse.T)
        return self._precision[1]


@dataclass
class ContactFit:
    """A fitted contact; the start of the next fit."""

    ratio: Array  # a, shape (2,)
    twist: float  # ω
    centre: Array  # c, shape (2,)
    normal: Array  # p, shape (n,)
    remainder: Array  # r, shape (2, n)
    cost: float
    rigid_covariance: Array  # of the loads' sums: shear x, y, normal, moment; shape (4, 4)
    wanted: NDArray[np.bool_]  # cells outside of the contact that a normal load would improve, shape (n,)

    def shear(self, position: Array) -> Array:
        """Shear load of each cell, shape (2, n)."""
        offset = position - self.centre
        ratio_x = self.ratio[0] - self.twist * offset[:, 1]
        ratio_y = self.ratio[1] + self.twist * offset[:, 0]
        return np.stack([ratio_x, ratio_y]) * self.normal + self.remainder


@dataclass
class _Data:
    """Normal equations of one image."""

    gram: Array  # (3n, 3n)
    projected: Array  # compliance ᵀ displacement, (3n,)
    square: float  # of the displacements
    weight: float  # 1 / variance of a displacement


@dataclass
class _Cells:
    """The cells that may bear loads, and the equations of their loads.

    A remainder is possible at the first cells only; p can be positive at all of them.
    """

    index: Indices  # (m,)
    gram: Array  # (3, m, 3, m)
    projected: Array  # (3, m)
    remainder: int  # number of cells with a remainder, k
    factor: Array  # lower Cholesky factor of the equations of r, (2k, 2k)


@dataclass
class _Loads:
    """p and r for given ratios, and the equations that remain for p without r."""

    normal: Array  # p, (m,)
    remainder: Array  # r, (2k,)
    cost: float
    matrix: Array  # of p, (m, m)
    cross: Array  # between r and p, solved with the factor of r, (2k, m)


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
    measured = np.where(valid[:, None], displacement, 0.0).T.ravel()
    projected = measured @ model.compliance
    data = _Data(model.gram(valid), projected, float(measured @ measured), 1 / noise**2)
    if start is None:
        fit = _first_fit(model, data)
        for _ in range(_STEPS):
            fit = _step(model, data, fit)
        return fit
    gathered = _gathered(start, model.position)
    fit = _step(model, data, gathered)
    return fit if _ratio_change(gathered, fit, model.position) < _CONVERGED else _step(model, data, fit)


def _first_fit(model: LayerModel, data: _Data) -> ContactFit:
    """The best of the fits without twist, with ratios along the shear that a linear estimate finds."""
    n = model.markers
    precision = np.kron(np.eye(3), np.linalg.inv(model.correlation + 1e-4 * np.eye(n))) / (5 * _SMALLEST_LOAD) ** 2
    estimate = solve_positive_definite(data.weight * data.gram + precision, data.weight * data.projected)
    shear = estimate[: 2 * n].reshape(2, n)
    total = shear.sum(1)
    size = float(np.hypot(*total))
    direction = total / size if size > 0 else total
    lengths = np.hypot(*shear)
    cells = max(float(lengths.sum() ** 2 / max((lengths**2).sum(), 1e-30)), 20.0)
    envelope = np.full(n, 1.5 * _REMAINDER * size / cells + _REMAINDER_FLOOR * _SMALLEST_LOAD)
    everywhere = _cells(model, data, envelope, np.ones(n, bool))
    weights = model.smoothing @ lengths
    centre = weights @ model.position / max(float(weights.sum()), 1e-30)
    best: tuple[float, float, Array] | None = None
    for ratio in _RATIOS if size > _REMAINDER_FLOOR else _RATIOS[:1]:
        scale = max(size / max(ratio, 0.05) / cells, _SMALLEST_LOAD)
        field = np.outer(ratio * direction, np.ones(n))
        loads = _loads(model, data, everywhere, field, scale, np.zeros(n, bool))
        if best is None or loads.cost < best[0]:
            best = loads.cost, ratio, loads.normal
    assert best is not None
    cost, ratio, normal = best
    return ContactFit(
        ratio * direction, 0.0, centre, normal, np.zeros((2, n)), cost, np.zeros((4, 4)), np.ones(n, bool)
    )


def _step(model: LayerModel, data: _Data, fit: ContactFit) -> ContactFit:
    """One step: p and r for the present a and ω, then a and ω by Gauss-Newton with all of them free."""
    n, position = model.markers, model.position
    ratio, twist, centre, normal = fit.ratio, fit.twist, fit.centre, fit.normal
    if normal.any():
        moved = normal @ position / normal.sum()
        ratio = ratio + twist * np.array([-(moved[1] - centre[1]), moved[0] - centre[0]])
        centre = moved
    envelope = 1.5 * (model.smoothing @ (0.3 * np.sqrt(normal * normal.max()) + 0.7 * normal))
    envelope *= _REMAINDER * (np.hypot(*ratio) + 1.3 * abs(twist)) + _REMAINDER_FLOOR
    cells = _cells(model, data, envelope + 1e-6, fit.wanted | (normal > 0))
    offset = position - centre
    field = np.stack([ratio[0] - twist * offset[:, 1], ratio[1] + twist * offset[:, 0]])
    pressed = normal[cells.index] > 0
    loads = _loads(model, data, cells, field[:, cells.index], _load_scale(normal), pressed)
    step = _gauss_newton(data, cells, loads, field, offset, np.array([*ratio, twist]))
    moved_normal, spread = np.zeros(n), np.zeros((2, n))
    moved_normal[cells.index] = np.maximum(loads.normal + step.normal, 0.0)
    spread[:, cells.index[: cells.remainder]] = (loads.remainder + step.remainder).reshape(2, -1)
    return ContactFit(
        ratio=ratio + step.rigid[:2],
        twist=float(twist + step.rigid[2]),
        centre=centre,
        normal=moved_normal,
        remainder=spread,
        cost=loads.cost,
        rigid_covariance=step.covariance,
        wanted=step.wanted,
    )


def _gathered(fit: ContactFit, position: Array) -> ContactFit:
    """The fit with all of its shear and moment in the rigid motion.

    A remainder that carries a part of these sums would keep it in the next step: in a contact that begins to slip the
    normal force would decrease by up to a half.
    """
    normal = fit.normal
    if not normal.any():
        return fit
    shear, total = fit.shear(position), float(normal.sum())
    centre = normal @ position / total
    x, y = (position - centre).T
    twist = float(x @ shear[1] - y @ shear[0]) / max(float(normal @ (x**2 + y**2)), 1e-9)
    return replace(fit, ratio=shear.sum(1) / total, twist=twist, centre=centre)


def _ratio_change(before: ContactFit, after: ContactFit, position: Array) -> float:
    """Change of the ratios of shear to normal load in a step, rms over the normal load before it."""
    squares = ((position - before.centre) ** 2).sum(1)
    square_radius = float(before.normal @ squares) / max(float(before.normal.sum()), 1e-30)
    change = after.ratio - before.ratio
    return float(np.sqrt(change @ change + square_radius * (after.twist - before.twist) ** 2))


@dataclass
class _Step:
    """Changes of (a, ω), p and r in a step with all of them free."""

    rigid: Array  # (3,)
    normal: Array  # (m,)
    remainder: Array  # (2k,)
    covariance: Array  # of the sums of the loads, see `ContactFit`
    wanted: NDArray[np.bool_]


def _gauss_newton(data: _Data, cells: _Cells, loads: _Loads, field: Array, offset: Array, rigid: Array) -> _Step:
    """One step of Gauss-Newton: r is eliminated first, then p.

    `field` (2, n) are the ratios of shear to p, `rigid` is (a, ω), `offset` the positions relative to the centre of
    pressure.
    """
    m, k, weight = cells.index.size, cells.remainder, data.weight
    positive = np.flatnonzero(loads.normal)
    arm = offset[cells.index].T
    ratio = field[:, cells.index]
    shear = np.zeros((2 * m, 3))  # loads per unit of a and ω
    shear[:m, 0] = shear[m:, 1] = loads.normal
    shear[:m, 2], shear[m:, 2] = -arm[1] * loads.normal, arm[0] * loads.normal
    response = weight * (shear.T @ cells.gram.reshape(3 * m, 3 * m)[: 2 * m]).T  # (3m, 3)
    gradient, wanted = _gradient(data, cells, loads, field)

    # Sums of the loads, as functions of (a, ω), p and r: shear x, y, normal, moment about the centre of pressure.
    both = np.zeros((3, m, 7))
    both[..., :3] = response.reshape(3, m, 3)
    both[0, :, 3] = both[1, :, 4] = both[2, :, 5] = 1.0
    both[0, :, 6], both[1, :, 6] = -arm[1], arm[0]
    of_rest = _lower(cells.factor, both[:2, :k].reshape(2 * k, 7))
    of_normal = both[2] + ratio[0][:, None] * both[0] + ratio[1][:, None] * both[1] - loads.cross.T @ of_rest
    of_rigid = shear.T @ both[:2].reshape(2 * m, 7) - of_rest[:, :3].T @ of_rest
    of_rigid[np.arange(3), np.arange(3)] += _RIGID_PRIOR
    covariance = of_rest[:, 3:].T @ of_rest[:, 3:]
    change_per_rigid = np.zeros((m, 3))
    if positive.size:
        of_normal = of_normal[positive]
        solved = solve_positive_definite(loads.matrix[positive[:, None], positive], of_normal)
        of_rigid -= of_normal[:, :3].T @ solved
        covariance += of_normal[:, 3:].T @ solved[:, 3:]
        change_per_rigid[positive] = -solved[:, :3]
    slope = gradient @ shear - _RIGID_PRIOR * rigid
    unknown = solve_positive_definite(of_rigid[:, :3], np.column_stack([slope, of_rigid[:, 3:]]))
    covariance += of_rigid[:, 3:].T @ unknown[:, 1:]
    step = unknown[:, 0] * min(1.0, _LARGEST_CHANGE / max(float(np.hypot(*unknown[:2, 0])), 1e-30))
    change = change_per_rigid @ step
    rest = -_upper(cells.factor, of_rest[:, :3] @ step + loads.cross @ change)
    return _Step(step, change, rest, covariance, wanted)


def _gradient(data: _Data, cells: _Cells, loads: _Loads, field: Array) -> tuple[Array, NDArray[np.bool_]]:
    """The gradient of the shear loads of the cells, shape (2m,), and the other cells that p would improve, (n,)."""
    index, k = cells.index, cells.remainder
    total = np.zeros((3, field.shape[1]))
    total[:2, index] = field[:, index] * loads.normal
    total[:2, index[:k]] += loads.remainder.reshape(2, k)
    total[2, index] = loads.normal
    gradient = data.weight * (data.projected - data.gram @ total.ravel()).reshape(total.shape)
    wanted = gradient[2] + field[0] * gradient[0] + field[1] * gradient[1] > 0
    wanted[index] = False
    return gradient[:2, index].ravel(), wanted


def _cells(model: LayerModel, data: _Data, envelope: Array, pressed: NDArray[np.bool_]) -> _Cells:
    """The cells where the remainder has a standard deviation `envelope` (n,) that is not small, and those `pressed`."""
    n = model.markers
    has_remainder = envelope > 0.05 * envelope.max()
    inner = np.flatnonzero(has_remainder)
    index = np.concatenate([inner, np.flatnonzero(pressed & ~has_remainder)])
    m, k = index.size, inner.size
    gram = data.gram
    if k < n:
        loads = np.concatenate([index, n + index, 2 * n + index])
        gram = gram.take(loads, 0).take(loads, 1)
    gram = gram.reshape(3, m, 3, m)
    inverse = 1 / envelope[inner]
    precision = model.precision(inner) * (inverse[:, None] * inverse)
    matrix = data.weight * gram[:2, :k, :2, :k]
    matrix[0, :, 0] += precision
    matrix[1, :, 1] += precision
    factor = _cholesky(matrix.reshape(2 * k, 2 * k))
    return _Cells(index, gram, data.projected.reshape(3, n)[:, index], k, factor)


def _loads(
    model: LayerModel, data: _Data, cells: _Cells, field: Array, scale: float, pressed: NDArray[np.bool_]
) -> _Loads:
    """p and r for the given ratios `field` (2, m) of shear to p.

    `scale` is that of p, and `pressed` (m,) the cells with p > 0 in a similar solution.
    """
    m, k, weight = cells.index.size, cells.remainder, data.weight
    along, across = field
    gram, projected = cells.gram, cells.projected
    rows = gram[2] + along[:, None, None] * gram[0] + across[:, None, None] * gram[1]  # (m, 3, m)
    own = rows[:, 2] + rows[:, 0] * along + rows[:, 1] * across
    linear = projected[2] + along * projected[0] + across * projected[1]
    # Solved with the factor of r, so that products of two columns are what r explains.
    columns = np.empty((m + 1, 2, k))
    columns[:m], columns[m] = rows[:, :2, :k], projected[:2, :k]
    columns *= weight
    solved = _lower(cells.factor, columns.reshape(m + 1, 2 * k).T)
    cross, right = solved[:, :m], solved[:, m]
    prior = _LOAD_PRIOR / scale**2 * model.roughness.take(cells.index, 0).take(cells.index, 1)
    matrix = weight * own + prior - cross.T @ cross
    linear = weight * linear - cross.T @ right
    loads = solve_nonnegative(matrix, linear, pressed)
    rest = _upper(cells.factor, right - cross @ loads)
    cost = weight * data.square - float(right @ right) - float(linear @ loads)
    return _Loads(loads, rest, cost, matrix, cross)


def _cholesky(matrix: Array) -> Array:
    """Lower Cholesky factor. Reads the triangle above the diagonal of `matrix`, and overwrites `matrix`."""
    factor, info = lapack.dpotrf(matrix.T, lower=1, clean=0, overwrite_a=1)
    if info != 0:
        raise LinAlgError("the equations of the remainder are not positive definite")
    return np.asarray(factor)


def _lower(factor: Array, right: Array) -> Array:
    return np.asarray(lapack.dtrtrs(factor, right, lower=1)[0])


def _upper(factor: Array, right: Array) -> Array:
    return np.asarray(lapack.dtrtrs(factor, right, lower=1, trans=1)[0])


def _load_scale(normal: Array) -> float:
    """Mean of the ten largest loads."""
    return max(float(np.sort(normal)[-10:].mean()), _SMALLEST_LOAD)
