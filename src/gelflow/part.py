"""Description of a part and its hole: plain data that checkpoints, the simulation and the mock robot share."""

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError

SHAPES = ("box", "cylinder", "mesh")
_FITS_FINGERS = 0.100  # largest distance between the pads [m]
_LONGEST, _WIDEST_CLEARANCE = 0.256, 0.020  # of a part, and of its hole [m]: larger ones are in another unit


@dataclass(frozen=True)
class Part:
    """A part that a parallel gripper inserts into a vertical hole. Lengths in metres; by default the cuboid.

    The frame of a part has its origin at the centre of its bounding box (of a mesh, x = 0 is halfway between the two
    grasped sides), x from the left to the right pad, and z up. The frame of the hole has its origin at the centre of
    the floor; the part fits where both frames are parallel and z axes coincide.
    """

    name: str = "cuboid"
    shape: str = "box"  # "box", "cylinder" (its axis is vertical) or "mesh"
    size: tuple[float, float, float] = (
        0.035,
        0.050,
        0.060,
    )  # of the bounding box: between the pads, along them, height
    grasp_width: float = 0.035  # distance of the pads at the grasp
    density: float = 600.0  # [kg/m³]
    clearance: tuple[float, float] = (4.5e-3, 4.5e-3)  # hole minus part along x and y: twice the gap on each side
    depth: float = 25e-3  # of the hole
    grasp_height: tuple[float, float] = (-10e-3, 5e-3)  # range of the pad centres above the part's centre
    # Rotations about z in a full turn that leave the part unchanged: 1 for none, 0 for any rotation (a round part).
    symmetry: int = 2
    mirror: tuple[str, ...] = ("x", "y")  # axes in which the part is its own mirror image: "x", "y", both or none
    mesh: str = ""  # SHA-256 of the mesh file; empty for box and cylinder
    mesh_scale: float = 1.0  # metres per unit of the mesh file
    mesh_file: str = field(default="", compare=False)  # on this computer; not part of the description
    # SHA-256 of the mesh around the hole; empty: the hole is the outline of the part, widened by the clearance. With a
    # mesh, the clearance is twice its smallest gap.
    hole_mesh: str = ""
    hole_scale: float = 1.0  # metres per unit of that file
    hole_origin: tuple[float, float] = (0.0, 0.0)  # of the part's frame in x and y of that file [m]
    hole_file: str = field(default="", compare=False)  # on this computer

    def __post_init__(self) -> None:
        """Raises UsageError, in one line, for values that no gripper and no hole can have."""
        if self.shape not in SHAPES:
            raise UsageError(f"shape must be one of {', '.join(SHAPES)}, got {self.shape!r}")
        for name in ("size", "grasp_width", "density", "clearance", "depth", "mesh_scale", "hole_scale"):
            value = getattr(self, name)
            if not all(0 < v < np.inf for v in (value if isinstance(value, tuple) else (value,))):
                raise UsageError(f"{name} must be above 0, got {list(value) if isinstance(value, tuple) else value}")
        for name, values, most in (("size", self.size, _LONGEST), ("clearance", self.clearance, _WIDEST_CLEARANCE)):
            if max(values) > most:
                raise UsageError(f"{name} may be at most {most:g} m, got {list(values)}; lengths are in metres")
        if self.grasp_width > _FITS_FINGERS:
            raise UsageError(
                f"the part is {self.grasp_width:g} m wide between the pads (grasp_width), which may be at most "
                f"{_FITS_FINGERS:g} m, the gripper's stroke; lengths are in metres"
            )
        low, high = self.grasp_height
        if not -self.size[2] / 2 < low <= high < self.size[2] / 2:
            half = self.size[2] / 2
            raise UsageError(f"grasp_height must be a range within ±{half:g} m of the part's centre, got {[low, high]}")
        if self.size[2] / 2 + low < self.depth / 2:
            raise UsageError(
                f"the part is {self.size[2]:g} m high and held {self.size[2] / 2 + low:g} m above its lower face; the "
                f"fingers would touch the rim of a hole of {self.depth:g} m: raise grasp_height or reduce depth"
            )
        if self.symmetry < 0:
            raise UsageError(
                f"symmetry must be 0 (round), 1 (none) or the number of equal rotations, got {self.symmetry}"
            )
        if not set(self.mirror) <= {"x", "y"}:
            raise UsageError(f"mirror may contain 'x' and 'y', got {list(self.mirror)}")
        if self.shape != "box" and self.clearance[0] != self.clearance[1]:
            raise UsageError(f"the clearance of a {self.shape} must be equal along x and y, got {list(self.clearance)}")

    def to_json(self) -> dict[str, Any]:
        """As plain data, for task descriptions; without paths of meshes, and without fields of an absent hole mesh."""
        values = dataclasses.asdict(self)
        absent = () if self.hole_mesh else ("hole_mesh", "hole_scale", "hole_origin")
        for key in ("mesh_file", "hole_file", *absent):
            del values[key]
        return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Self:
        """Inverse of `to_json`. Raises UsageError on unknown keys."""
        known = {field.name for field in dataclasses.fields(cls)}
        if unknown := set(data) - known:
            raise UsageError(f"part has unknown keys {sorted(unknown)}; known are {sorted(known)}")
        values: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value for key, value in data.items()
        }
        return cls(**values)

    @property
    def is_round(self) -> bool:
        """Whether every rotation about z leaves the part unchanged."""
        return self.symmetry == 0

    def yaw_error(self, yaw: NDArray[np.float64]) -> NDArray[np.float64]:
        """The smallest rotation [rad] from yaw angles (…) to one at which the part fits; 0 for a round part."""
        yaw = np.asarray(yaw, dtype=float)
        if self.is_round:
            return np.zeros_like(yaw)
        period = 2 * np.pi / self.symmetry
        return np.asarray(yaw - period * np.round(yaw / period))


CUBOID = Part()
