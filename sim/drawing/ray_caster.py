"""Shaded pictures of geometries by MuJoCo's ray casting, which runs on the processor and needs no OpenGL."""

from dataclasses import dataclass
from typing import Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from gelflow.figures import BLUE, GREEN, ORANGE, PURPLE, SKY_BLUE
from gelflow.sim.drawing.camera import Camera
from gelflow.sim.drawing.scene_drawing import SceneDrawing
from gelflow.sim.scene.mjcf.mechanics import WORLD, GeomDef

Array = NDArray[np.float64]

_COLORS = (BLUE, ORANGE, GREEN, SKY_BLUE, PURPLE)  # without that of the contact forces, VERMILION
_WORLD_COLOR, _PLANE_COLOR, _BACKGROUND = (176, 176, 176), (232, 232, 228), (250, 250, 250)
_LIGHT = np.array([-0.35, -0.45, 0.85])  # direction to the light, in axes of the camera's azimuth
_AMBIENT, _HEADLIGHT, _DIFFUSE = 0.42, 0.2, 0.42  # shares of the brightness
_LINE_WIDTH, _LINE_GROWTH, _LINE_CONTRAST = 0.012, 0.0015, 0.12  # of lines on planes, in tiles
_HORIZON = 7.0  # distance at which planes end, in distances of the camera's target
_NO_BODY = -2
_EDGE = 0.45  # brightness at the edges of bodies
_CREASE = 0.8  # cosine of the angle between normals from which an edge is drawn
_FAR = 1e10


@dataclass(frozen=True)
class View:
    """Projection of world points into a picture."""

    camera: Camera
    size: tuple[int, int]  # width and height [px]
    center: tuple[float, float]  # pixel of the target

    @property
    def focal(self) -> float:
        """Focal length [px]."""
        return float(self.size[1] / 2 / np.tan(np.radians(self.camera.fov) / 2))

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixels (n, 2) and distances along the optical axis [m], (n,), of world points (n, 3)."""
        x, y, back = ((points - self.camera.position) @ self.camera.axes.T).T
        depth = np.maximum(-back, 1e-9)
        return np.column_stack(
            [self.center[0] + self.focal * x / depth, self.center[1] - self.focal * y / depth]
        ), -back

    def directions(self) -> Array:
        """Unit vectors of the rays through the pixels, row by row, (width * height, 3)."""
        width, height = self.size
        x = (np.arange(width) + 0.5 - self.center[0]) / self.focal
        y = (self.center[1] - np.arange(height) - 0.5) / self.focal
        right, up, back = self.camera.axes
        rays = x[None, :, None] * right + y[:, None, None] * up - back
        return np.asarray((rays / np.linalg.norm(rays, axis=2, keepdims=True)).reshape(-1, 3))


class RayCaster:
    """Draws the geometries of one scene; the poses of the bodies may change from picture to picture."""

    def __init__(self, geoms: tuple[GeomDef, ...], bodies: int) -> None:
        self._model, bodies_of_geoms = _mujoco_model(geoms, bodies)
        self._data: Any = mujoco.MjData(self._model)
        # Per geometry of the model, and last of the background, whose number is -1: owner, whether a plane, colour.
        owner = np.append(bodies_of_geoms, _NO_BODY)
        self._plane = np.append(self._model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, False)
        self._owner = np.where(self._plane, _NO_BODY - 1, owner)
        colors = body_colors(owner)
        colors[self._plane], colors[-1] = _PLANE_COLOR, _BACKGROUND
        self._colors = np.ascontiguousarray(colors.T, dtype=np.float32)  # by channel
        self._view: View | None = None  # that of the rays
        self._rays, self._rays_xy = np.zeros((0, 3)), np.zeros((2, 0), dtype=np.float32)

    def draw(self, drawing: SceneDrawing, view: View, *, tile: float) -> tuple[NDArray[np.uint8], Array]:
        """Picture (height, width, 3) and distance of each pixel from the camera [m], (height, width).

        `tile` is the distance of the lines on planes [m].
        """
        for body, pose in enumerate(drawing.poses):
            self._data.mocap_pos[body], self._data.mocap_quat[body] = pose.position, pose.quaternion
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        if self._view != view:
            self._view, self._rays = view, view.directions()
            self._rays_xy = np.ascontiguousarray(self._rays[:, :2].T, dtype=np.float32)
        eye, (width, height) = view.camera.position, view.size
        geom, distance, normals = self._cast(eye, self._rays, normals=True)
        normal = normals.astype(np.float32)
        distance[distance < 0] = _FAR
        right, _, back = view.camera.axes
        light = _LIGHT @ np.array([right, np.cross([0, 0, 1], right), [0, 0, 1]])
        light /= np.linalg.norm(light)
        lit = self._lit(geom, distance, light, view)
        shade = normal @ light.astype(np.float32)
        np.clip(shade, 0, 1, out=shade)
        shade *= _DIFFUSE * lit
        shade += _AMBIENT + _HEADLIGHT * np.abs(normal @ back.astype(np.float32))
        shade[geom < 0] = 1
        plane = self._plane.take(geom, mode="wrap")
        near, line = self._planes(eye, distance, tile)
        shade *= np.where(plane, near * line, np.float32(1))
        background = np.where(plane, 1 - near, np.float32(0))
        channels = [  # one after the other: NumPy is slow along short axes
            color.take(geom, mode="wrap") * shade + color[-1] * background for color in self._colors
        ]
        picture = cv2.merge([channel.reshape(height, width) for channel in channels])
        edges = self._edges(geom.reshape(height, width), normal.reshape(height, width, 3))
        return _with_edges(picture, edges), distance.reshape(height, width)

    def _cast(self, origin: Array, rays: Array, *, normals: bool = False) -> tuple[NDArray[np.int32], Array, Array]:
        count = len(rays)
        geom, distance = np.full(count, -1, dtype=np.int32), np.full(count, -1.0)
        normal = np.zeros((count if normals else 0, 3))
        mujoco.mj_multiRay(
            self._model, self._data, origin, rays.reshape(-1), None, 1, -1, geom, distance,
            normal.reshape(-1) if normals else None, count, _FAR,
        )  # fmt: skip
        return geom, distance, normal

    def _lit(self, geom: NDArray[np.int32], distance: Array, light: Array, view: View) -> NDArray[np.float32]:
        """1 at pixels that the light reaches, 0 in shadow, by rays from the light to every second pixel."""
        width, height = view.size
        every_second = np.arange(height * width).reshape(height, width)[::2, ::2].reshape(-1)
        seen = every_second[geom[every_second] >= 0]
        lamp = np.array(view.camera.target) + 6 * view.camera.distance * light
        toward = view.camera.position - lamp + distance[seen, None] * self._rays[seen]
        length = np.sqrt(np.einsum("ij,ij->i", toward, toward))
        _, hit, _ = self._cast(lamp, toward / length[:, None])
        lit = np.ones(height * width, dtype=np.float32)
        lit[seen] = (hit < 0) | (hit > length - 2e-3 * view.camera.distance)
        soft = cv2.GaussianBlur(np.ascontiguousarray(lit.reshape(height, width)[::2, ::2]), (5, 5), 0)
        fine = cv2.resize(soft, (width, height), interpolation=cv2.INTER_LINEAR)
        return np.asarray(fine, dtype=np.float32).reshape(-1)

    def _planes(self, eye: Array, distance: Array, tile: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Visibility of each pixel if it is on a plane, 0 at the horizon, and brightness by the lines `tile` apart."""
        assert self._view is not None
        horizon = _HORIZON * self._view.camera.distance
        away = np.minimum(distance, horizon).astype(np.float32)
        near = np.asarray(np.square(1 - np.square(away / np.float32(horizon))), dtype=np.float32)
        width = away * np.float32(_LINE_GROWTH / tile) + np.float32(_LINE_WIDTH)
        line = np.zeros(len(away), dtype=bool)
        for axis in range(2):
            cell = self._rays_xy[axis] * away * np.float32(1 / tile) + np.float32(eye[axis] / tile)
            line |= np.abs(cell - np.rint(cell)) < width
        return near, np.asarray(1 - _LINE_CONTRAST * line, dtype=np.float32)

    def _edges(self, geom: NDArray[np.int32], normal: NDArray[np.float32]) -> NDArray[np.float32]:
        """1 at pixels where bodies or faces meet, (height, width)."""
        owner = self._owner.take(geom, mode="wrap")
        faces = owner >= WORLD
        edge = np.zeros(geom.shape, dtype=np.float32)
        x, y, z = cv2.split(normal)
        for now, before in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
            cosine = x[now] * x[before] + y[now] * y[before] + z[now] * z[before]
            edge[now][(owner[now] != owner[before]) | ((cosine < _CREASE) & faces[now])] = 1
        return edge


def body_colors(bodies: NDArray[np.int64]) -> NDArray[np.int64]:
    """RGB colours (n, 3) of bodies by their number; negative numbers are the world."""
    palette = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in _COLORS])
    return np.where(bodies[:, None] < 0, _WORLD_COLOR, palette[bodies % len(palette)])


def _with_edges(picture: NDArray[np.float32], edges: NDArray[np.float32]) -> NDArray[np.uint8]:
    """The picture with dark, smooth edges."""
    soft = cv2.GaussianBlur(edges, (3, 3), 0)
    at = np.flatnonzero(soft)
    smooth = cv2.blur(picture, (3, 3)).reshape(-1, 3)
    picture.reshape(-1, 3)[at] = smooth[at] * (1 - (1 - _EDGE) * soft.reshape(-1)[at, None])
    return np.asarray(cv2.convertScaleAbs(picture), dtype=np.uint8)


def _mujoco_model(geoms: tuple[GeomDef, ...], bodies: int) -> tuple[Any, NDArray[np.int64]]:
    """A model with one mocap body per moving body, and the moving body of each of its geometries (-1: the world)."""
    spec = mujoco.MjSpec()
    parents = [spec.worldbody.add_body(name=f"body{i}", mocap=True) for i in range(bodies)]
    for number, geom in enumerate(geoms):
        parent = spec.worldbody if geom.body == WORLD else parents[geom.body]
        arguments: dict[str, Any] = {"pos": geom.pose.position, "quat": geom.pose.quaternion, "size": geom.size}
        if geom.kind == "plane":
            arguments["size"] = [0, 0, 1]  # infinite
        if geom.mesh is not None:
            spec.add_mesh(
                name=f"mesh{number}",
                uservert=geom.mesh.vertices.ravel(),
                userface=geom.mesh.faces.ravel().astype(np.int32),
                inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,  # accepts surfaces that are not closed
            )
            arguments |= {"meshname": f"mesh{number}", "size": np.zeros(3)}
        kind = getattr(mujoco.mjtGeom, f"mjGEOM_{geom.kind.upper()}")
        parent.add_geom(name=f"geom{number}", type=kind, contype=0, conaffinity=0, **arguments)
    model = spec.compile()
    order = [model.geom(f"geom{number}").id for number in range(len(geoms))]
    owner = np.full(len(geoms), WORLD)
    owner[order] = [geom.body for geom in geoms]
    return model, owner
