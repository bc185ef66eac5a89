"""Cameras of pictures, and the default view of a scene."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim.arguments import number_array, shown
from gelflow.sim.drawing.scene_drawing import Polyline, SceneDrawing
from gelflow.sim.scene.mjcf.mechanics import WORLD, GeomDef
from gelflow.toml_tables import suggestion

Array = NDArray[np.float64]

# Name → azimuth and elevation [deg].
VIEWS = {"oblique": (-55.0, 28.0), "front": (-90.0, 4.0), "side": (0.0, 4.0), "top": (-90.0, 89.0)}
_MARGIN = 1.12  # of the sphere around the scene
_LARGE = 4.0  # geometries of the world that are larger than the moving ones by this factor are not framed


@dataclass(frozen=True)
class Camera:
    """A camera that looks at a point from a distance, with world z upwards in its pictures."""

    target: tuple[float, float, float]  # [m]
    distance: float  # from the target [m]
    azimuth: float = VIEWS["oblique"][0]  # of the camera seen from the target, from world x towards y [deg]
    elevation: float = VIEWS["oblique"][1]  # of the camera above the horizontal plane through the target [deg]
    fov: float = 40.0  # vertical field of view [deg]

    def __post_init__(self) -> None:
        target = number_array("camera: target", self.target, float)
        others = number_array("camera", (self.distance, self.azimuth, self.elevation, self.fov), float)
        if target.shape != (3,) or not (np.isfinite(target).all() and np.isfinite(others).all()):
            raise UsageError(f"camera: target must be three numbers, and all numbers finite, got {shown(self)}")
        if not (self.distance > 0 and 0 < self.fov < 180 and abs(self.elevation) <= 90):
            raise UsageError(
                "camera: distance must be above 0, fov within 0 to 180 degrees and elevation within ±90 degrees, got "
                f"{self.distance:g}, {self.fov:g} and {self.elevation:g}"
            )

    @property
    def axes(self) -> Array:
        """Rows: right, up and backwards (from target to camera) in the world, shape (3, 3)."""
        azimuth, elevation = np.radians([self.azimuth, self.elevation])
        sin, cos, low, high = np.sin(azimuth), np.cos(azimuth), np.cos(elevation), np.sin(elevation)
        return np.array([[-sin, cos, 0.0], [-high * cos, -high * sin, low], [low * cos, low * sin, high]])

    @property
    def position(self) -> Array:
        """Position in the world [m], shape (3,)."""
        return np.asarray(np.array(self.target) + self.distance * self.axes[2])


def framing_camera(
    drawings: list[SceneDrawing], view: str = "oblique", *, aspect: float = 1.0, polylines: Sequence[Polyline] = ()
) -> Camera:
    """A camera that sees the moving bodies, the pads, what is near them in all drawings of a scene, and polylines.

    `view` is one of `VIEWS`, `aspect` width by height of the picture. Raises UsageError on an unknown view.
    """
    if not isinstance(view, str) or view not in VIEWS:
        raise UsageError(f"no view {shown(view)}; {suggestion(str(view), VIEWS)}")
    moving = [_extent(drawing, geom) for drawing in drawings for geom in drawing.geoms if geom.body != WORLD]
    points = [pad.positions for drawing in drawings for pad in drawing.pads]
    points += [np.array([pose.position for pose in drawing.poses]) for drawing in drawings if not moving and not points]
    points += moving
    corners = np.concatenate([*points, *(polyline.points for polyline in polylines)])
    size = float(np.ptp(corners, axis=0).max())
    for geom in drawings[0].geoms:
        if geom.body == WORLD and geom.kind != "plane":
            fixed = _extent(drawings[0], geom)
            if np.ptp(fixed, axis=0).max() < _LARGE * max(size, 1e-3):
                corners = np.concatenate([corners, fixed])
    middle = (corners.min(0) + corners.max(0)) / 2
    radius = max(float(np.linalg.norm(corners - middle, axis=1).max()), 1e-3)
    x, y, z = (float(value) for value in middle)
    azimuth, elevation = VIEWS[view]
    half = np.radians(Camera.fov / 2)
    smallest = min(half, float(np.arctan(np.tan(half) * aspect)))
    return Camera((x, y, z), _MARGIN * radius / float(np.sin(smallest)), azimuth, elevation)


def _extent(drawing: SceneDrawing, geom: GeomDef) -> Array:
    """Corners of the bounding box of a geometry in the world [m], (8, 3); of a plane its origin."""
    size = geom.size
    if geom.mesh is not None:
        low, high = geom.mesh.vertices.min(0), geom.mesh.vertices.max(0)
    else:
        half = {
            "plane": np.zeros(3),
            "sphere": np.full(3, size[0]),
            "cylinder": size[[0, 0, 1]],
            "capsule": np.array([size[0], size[0], size[0] + size[1]]),
        }.get(geom.kind, size)
        low, high = -half, half
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    return drawing.geom_pose(geom).apply(low + corners * (high - low))
