"""Linear functions of the marker forces of pads, such as force and moment; the core records them in place of markers.

Forces and moments are those on the pad, in the frame of its site: z is the outward normal of a flat pad, x points to
the tip of the finger.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gelflow.errors import UsageError
from gelflow.sim import _core
from gelflow.sim.arguments import check_type, floating, number_array, shown

if TYPE_CHECKING:  # loading a scene needs MuJoCo, which a simulator of a core model does not
    from gelflow.sim.scene.pads import PadDef
    from gelflow.sim.scene.scene import Scene

Array = NDArray[np.float64]

_AXES = ("x", "y", "z")


@dataclass(frozen=True, eq=False)
class TactileReduction:
    """A linear function of all marker forces of a scene: row r is Σ matrix[r, i] · forces[i] over the markers i.

    Pass it to `Simulator.rollout`, `Simulator.tactile` or `torch_rollout`, which then return (…, rows) instead of (…,
    markers, 3), with gradients. Calling it with marker forces (…, markers, 3) gives the same numbers. Raises UsageError
    for a matrix of another shape or with values that are not finite.
    """

    matrix: Array  # (rows, markers, 3)
    names: tuple[str, ...]  # of the rows

    def __post_init__(self) -> None:
        matrix = number_array("matrix", self.matrix, float)
        if matrix.ndim != 3 or matrix.shape[2] != 3 or not np.isfinite(matrix).all():
            raise UsageError(f"matrix must be finite, of shape (rows, markers, 3), got {matrix.shape}")
        check_type("names", self.names, Sequence, "the names of the rows")
        if len(self.names) != len(matrix):
            raise UsageError(f"expected {len(matrix)} names of rows, got {len(self.names)}")
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "names", tuple(self.names))

    def __call__(self, forces: Any) -> Any:
        """The rows, (…, rows), of marker forces (…, markers, 3): an array or a tensor."""
        rows, markers, _ = self.matrix.shape
        if not (isinstance(forces, np.ndarray) or hasattr(forces, "requires_grad")):
            forces = number_array("forces", forces, float)
        forces = floating(forces)
        if tuple(forces.shape[-2:]) != (markers, 3):
            raise UsageError(f"forces must have shape (…, {markers}, 3), got {tuple(forces.shape)}")
        flat = forces.reshape((*forces.shape[:-2], markers * 3))
        matrix = self.matrix.reshape(rows, markers * 3).T
        if isinstance(flat, np.ndarray):
            return flat @ matrix
        import torch  # deferred: only tensors need torch

        return flat @ torch.from_numpy(matrix).to(flat)

    @cached_property
    def core(self) -> _core.TactileReduction:
        """The matrix in the layout of the core."""
        return _core.TactileReduction(np.ascontiguousarray(self.matrix))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.matrix, self.names)  # without `core`, which cannot be pickled

    @classmethod
    def concatenate(cls, reductions: Sequence["TactileReduction"]) -> "TactileReduction":
        """The rows of all `reductions`, one after the other. Raises UsageError for different numbers of markers."""
        for reduction in reductions:
            check_type("each of reductions", reduction, cls, "a TactileReduction")
        if len(markers := {reduction.matrix.shape[1] for reduction in reductions}) != 1:
            raise UsageError(f"reductions must be of one number of markers, got {sorted(markers)}")
        return cls(
            np.concatenate([reduction.matrix for reduction in reductions]),
            tuple(name for reduction in reductions for name in reduction.names),
        )


def pad_forces(scene: "Scene", pads: Sequence[str] | None = None) -> TactileReduction:
    """The force on each pad [N]: three rows a pad, `PAD.force.x` and so on. `pads`: names; None takes all."""

    def rows(pad: "PadDef") -> Array:
        return _force_axes(pad).transpose(1, 0, 2)

    return _per_pad(scene, pads, [f"force.{axis}" for axis in _AXES], rows)


def pad_moments(scene: "Scene", pads: Sequence[str] | None = None) -> TactileReduction:
    """The moment on each pad about its centre, the mean marker position [N m]: three rows a pad."""

    def rows(pad: "PadDef") -> Array:
        arms = _positions(pad) - _positions(pad).mean(0)
        return np.cross(arms[:, :, None], _force_axes(pad), axis=1).transpose(1, 0, 2)

    return _per_pad(scene, pads, [f"moment.{axis}" for axis in _AXES], rows)


def pad_pressures(scene: "Scene", pads: Sequence[str] | None = None) -> TactileReduction:
    """The sum of the normal forces of each pad [N] and their first moment about its site [N m]: four rows a pad.

    The rows are `PAD.pressure` and `PAD.pressure_moment.x` and so on, in the frame of the site. Moment / sum is the
    centre of pressure of a pad of any shape; `center_of_pressure` is that of flat pads.
    """

    def rows(pad: "PadDef") -> Array:
        positions = _positions(pad)
        weights = np.concatenate([np.ones((1, len(positions))), positions.T])
        return np.asarray(weights[:, :, None] * np.array([0.0, 0.0, 1.0]))

    return _per_pad(scene, pads, ["pressure", *(f"pressure_moment.{axis}" for axis in _AXES)], rows)


def mean_shear(scene: "Scene", pads: Sequence[str] | None = None) -> TactileReduction:
    """The mean of the shear x and of the shear y over the markers of each pad [N]: two rows a pad."""

    def rows(pad: "PadDef") -> Array:
        count = len(pad.positions)
        return np.repeat(np.eye(3)[:2, None], count, axis=1) / count

    return _per_pad(scene, pads, ["mean_shear.x", "mean_shear.y"], rows)


def shear_features(scene: "Scene", basis: ArrayLike, pads: Sequence[str] | None = None) -> TactileReduction:
    """Projections of the shear of each pad on the columns of `basis` (markers of a pad, terms).

    The rows of a pad are the terms of shear x, then those of shear y, in the order of `normalize`'s flow maps. With the
    `polynomial_basis` of gelflow.policies they are polynomial features. Raises UsageError where a pad has another
    number of markers than the basis.
    """
    columns = number_array("basis", basis, float)
    if columns.ndim != 2:
        raise UsageError(f"basis must have shape (markers of a pad, terms), got {columns.shape}")

    def rows(pad: "PadDef") -> Array:
        if len(columns) != len(pad.positions):
            raise UsageError(
                f"basis must have shape ({len(pad.positions)}, terms) for pad {pad.name!r}, got {columns.shape}"
            )
        return np.concatenate([columns.T[:, :, None] * np.eye(3)[component] for component in (0, 1)])

    terms = range(columns.shape[-1])
    return _per_pad(scene, pads, [f"shear_{axis}.{term}" for axis in "xy" for term in terms], rows)


def center_of_pressure(force: Any, moment: Any) -> Any:
    """Centre of pressure (…, 2) on flat pads, x and y from the pad's centre [m]; 0 without normal force.

    `force` and `moment` (…, 3) are the rows of `pad_forces` and `pad_moments` of a pad: arrays, or tensors with
    gradients. From M = r × F with r in the plane of the markers: x = M_y / −F_z, y = −M_x / −F_z.
    """
    for name, value in (("force", force), ("moment", moment)):
        if not (isinstance(value, np.ndarray) or hasattr(value, "requires_grad")) or value.shape[-1:] != (3,):
            raise UsageError(f"{name} must be an array or a tensor of shape (…, 3), got {shown(value)}")
    if type(force) is not type(moment) or force.shape != moment.shape:
        raise UsageError(f"force and moment must have the same type and shape, got {shown(force)} and {shown(moment)}")
    xp: Any = np
    if not isinstance(force, np.ndarray):
        import torch  # deferred: only tensors need torch

        xp = torch
    normal = -force[..., 2]
    touched = normal > 0
    along = xp.stack([moment[..., 1], -moment[..., 0]], -1)
    # Without normal force the divisor is 1, so that gradients are finite there too.
    divisor = xp.where(touched, normal, xp.ones_like(normal))
    return xp.where(touched[..., None], along / divisor[..., None], xp.zeros_like(along))


def _per_pad(scene: "Scene", pads: Sequence[str] | None, names: Sequence[str], rows: Any) -> TactileReduction:
    """A reduction with the same named rows for each pad; `rows`(pad) has shape (rows, markers of the pad, 3)."""
    if not hasattr(scene, "pads"):
        raise UsageError(f"scene must be a Scene (see load_scene), got {shown(scene)}")
    if not (pads is None or isinstance(pads, list | tuple)):
        raise UsageError(f"pads must be a list of names, got {shown(pads)}")
    chosen = [pad.name for pad in scene.pads] if pads is None else list(pads)
    slices = {name: scene.marker_slice(name) for name in chosen}  # raises for an unknown name
    matrix = np.zeros((len(chosen) * len(names), scene.num_markers, 3))
    by_name = {pad.name: pad for pad in scene.pads}
    for i, name in enumerate(chosen):
        matrix[i * len(names) : (i + 1) * len(names), slices[name]] = rows(by_name[name])
    return TactileReduction(matrix, tuple(f"{pad}.{name}" for pad in chosen for name in names))


def _positions(pad: "PadDef") -> Array:
    """Marker positions in the frame of the pad's site [m], (markers, 3)."""
    return np.asarray((pad.positions - pad.pose.position) @ pad.pose.matrix())


def _force_axes(pad: "PadDef") -> Array:
    """Force on the pad, in the site's frame, per unit of shear x, shear y and normal of a marker, (markers, 3, 3)."""
    return np.asarray(pad.pose.matrix().T @ pad.axes * [1.0, 1.0, -1.0])
