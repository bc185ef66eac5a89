"""The content of a picture of one environment: geometries, contact forces and pad readings, in world coordinates."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.geometry import Pose, multiply
from gelflow.sim import _core, arguments
from gelflow.sim.scene import Scene
from gelflow.sim.scene.geometry.distance_grid import DistanceGrid
from gelflow.sim.scene.geometry.mesh import TriangleMesh
from gelflow.sim.scene.mjcf.mechanics import WORLD, GeomDef
from gelflow.sim.scene.model_spec import core_shape
from gelflow.sim.scene.pads import PadDef
from gelflow.sim.scene.shapes import ShapeDef
from gelflow.sim.simulator import Simulator

Array = NDArray[np.float64]

DRAWN_KINDS = ("plane", "sphere", "box", "cylinder", "capsule", "ellipsoid", "mesh")
_NO_FORCE = 1e-6  # [N]; smaller contact forces are not drawn


@dataclass(frozen=True, eq=False)
class Polyline:
    """A line that is drawn into the scene, such as the outline of a goal. Raises UsageError for invalid points."""

    points: Array  # in the world [m], (n, 3)
    label: str

    def __post_init__(self) -> None:
        points = arguments.number_array("points of a polyline", self.points, float)
        if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.isfinite(points).all():
            given = arguments.shown(self.points)
            raise UsageError(f"points of a polyline must be a list of [x, y, z], all finite, got {given}")
        arguments.check_type("the label of a polyline", self.label, str, "a string")
        object.__setattr__(self, "points", points)


@dataclass(frozen=True, eq=False)
class ContactForce:
    """The total force of a contact on the body of its points."""

    name: str
    point: Array  # where it acts, in the world [m], shape (3,)
    force: Array  # in the world [N], shape (3,)


@dataclass(frozen=True, eq=False)
class PadReading:
    """Markers of a pad with their forces."""

    name: str
    positions: Array  # in the world [m], shape (n, 3)
    layout: Array  # x (to the fingertip) and y of the markers in the frame of the pad's site [m], shape (n, 2)
    shear: Array  # along x and y of the site [N], shape (n, 2)
    normal: Array  # ≥ 0 in compression [N], shape (n,)


@dataclass(frozen=True, eq=False)
class SceneDrawing:
    """One environment as it is drawn."""

    geoms: tuple[GeomDef, ...]  # in the frames of their bodies
    poses: tuple[Pose, ...]  # of the moving bodies in the world
    contacts: tuple[ContactForce, ...]
    pads: tuple[PadReading, ...]

    def geom_pose(self, geom: GeomDef) -> Pose:
        """The pose of a geometry in the world."""
        return geom.pose if geom.body == WORLD else self.poses[geom.body] @ geom.pose


def scene_drawing(sim: Simulator, env: int = 0) -> SceneDrawing:
    """The drawing of environment `env` at its present state.

    Raises UsageError if there is no such environment, and for a simulator that was made from a core model: that has no
    geometries to draw.
    """
    if not isinstance(sim.scene, Scene):
        raise UsageError("a simulator of a core model cannot be drawn; make it from a Scene, see load_scene")
    env = arguments.integer("env", env, minimum=0)
    if env >= sim.num_envs:
        raise UsageError(f"env must be below {sim.num_envs}, the number of environments, got {env}")
    poses = tuple(Pose(row[:3].astype(float), row[3:].astype(float)) for row in sim.poses()[env])
    geoms = drawn_geoms(sim, env)
    return SceneDrawing(geoms, poses, _contact_forces(sim, env, poses), _pad_readings(sim, env, poses))


def drawn_geoms(sim: Simulator, env: int) -> tuple[GeomDef, ...]:
    """The geometries of the model file and the shapes of the scene, with the sizes and positions of an environment."""
    scene: Scene = sim.scene
    shapes = {shape.name: shape for shape in scene.shapes}
    files = {geom.name: geom for geom in scene.geoms}
    drawn = [geom for geom in scene.geoms if geom.name not in shapes and geom.kind in DRAWN_KINDS]
    return (*drawn, *(_shape_geom(sim, env, shape, files.get(shape.name)) for shape in scene.shapes))


def _shape_geom(sim: Simulator, env: int, shape: ShapeDef, file: GeomDef | None) -> GeomDef:
    size = _vector(sim, env, "shape", f"{shape.name}.size")
    pose = _pose(sim, env, "shape", f"{shape.name}.shape", shape.pose)
    if shape.grid is None:
        return GeomDef(shape.name, shape.body, shape.kind, pose, size)
    mesh = file.mesh if file is not None and file.mesh is not None else grid_mesh(shape.grid)
    scaled = replace(mesh, vertices=mesh.vertices * size[0])  # the first size of a mesh is its scale
    return GeomDef(shape.name, shape.body, shape.kind, pose, size, scaled)


def _pose(sim: Simulator, env: int, kind: str, name: str, pose: Pose) -> Pose:
    """The pose in its body of a shape, a point set or a pad of an environment; `pose` is that of the scene."""
    position, turn = (_vector(sim, env, kind, f"{name}.{key}") for key in ("pos", "turn"))
    half = np.linalg.norm(turn) / 2
    rotation = (np.cos(half), *(0.5 * np.sinc(half / np.pi) * turn))
    return Pose(position, np.array(multiply(pose.quaternion, rotation)))


def _vector(sim: Simulator, env: int, kind: str, name: str) -> Array:
    """Three parameters of an environment, with the endings x, y and z."""
    names = [arguments.qualified(f"{name}.{axis}", sim.param_index, kind) for axis in "xyz"]
    return np.array([float(sim.param(name)[env]) for name in names])


def grid_mesh(grid: DistanceGrid) -> TriangleMesh:
    """The surface of a distance grid: where the distance is 0, by marching cubes."""
    from skimage import measure  # deferred: slow to import

    cubes: Any = measure.marching_cubes
    # A node's value of a cubic B-spline is the mean of its coefficient and the neighbours, weighted 1 4 1 per axis.
    values = grid.coefficients.astype(float)
    for axis in range(3):
        v = np.moveaxis(values, axis, 0)
        values = np.moveaxis((v[:-2] + 4 * v[1:-1] + v[2:]) / 6, 0, axis)
    outside = float(np.abs(values).max())
    closed = np.pad(values, 1, constant_values=outside)  # a surface that is cut by the edge of the grid is closed
    vertices, faces, *_ = cubes(closed, 0.0)
    return TriangleMesh(grid.origin + (vertices - 1) * grid.spacing, np.asarray(faces, dtype=np.int64))


def _contact_forces(sim: Simulator, env: int, poses: Sequence[Pose]) -> tuple[ContactForce, ...]:
    scene: Scene = sim.scene
    if not scene.contacts:
        return ()
    shapes = {shape.name: shape for shape in scene.shapes}
    clouds = {cloud.name: cloud for cloud in scene.points}
    found = []
    # Contacts of pads that collide follow those of the scene; the readings of the pads show their forces.
    for contact, wrench in zip(scene.contacts, sim.wrenches()[env].astype(float), strict=False):
        force = wrench[3:]
        if not np.linalg.norm(force) > _NO_FORCE:
            continue
        cloud, shape = clouds[contact.points], shapes[contact.shape]
        scaled = _vector(sim, env, "points", f"{cloud.name}.points.scale") * cloud.pose.inverse().apply(cloud.points)
        points = _pose(sim, env, "points", f"{cloud.name}.points", cloud.pose).apply(scaled)
        points = points if cloud.body == WORLD else poses[cloud.body].apply(points)
        frame = _pose(sim, env, "shape", f"{shape.name}.shape", shape.pose)
        frame = frame if shape.body == WORLD else poses[shape.body] @ frame
        distance, normal = _distance(sim, env, shape, frame.inverse().apply(points))
        points = points - cloud.radius * normal @ frame.matrix().T  # of a sphere, the point next to the shape
        distance = distance - cloud.radius
        depth = np.maximum(-distance, 0)
        point = depth @ points / depth.sum() if depth.sum() > 0 else points[np.argmin(distance)]
        found.append(ContactForce(contact.name, np.asarray(point), force))
    return tuple(found)


def _distance(sim: Simulator, env: int, shape: ShapeDef, points: Array) -> tuple[Array, Array]:
    """Distances (n,) and normals (n, 3) of a shape, with the size that an environment has, at points in its frame."""
    size = _vector(sim, env, "shape", f"{shape.name}.size")
    model = sim.model
    if not np.allclose(size, shape.size, rtol=1e-6, atol=0):  # up to single precision
        spec = _core.ModelSpec()
        # A model needs something that can move.
        body = spec.add_body(_core.BodyDef(name="body", mass=1.0, inertia=[1.0, 1.0, 1.0, 0.0, 0.0, 0.0]))
        spec.add_joint(_core.JointDef(name="joint", body=body, type="slide", axis=[1.0, 0.0, 0.0]))
        spec.add_shape(core_shape(replace(shape, body=WORLD, size=size)))
        model = _core.Model(spec)
    distance, normal = model.distance(shape.name, points)[:2]
    return distance, normal


def _pad_readings(sim: Simulator, env: int, poses: Sequence[Pose]) -> tuple[PadReading, ...]:
    scene: Scene = sim.scene
    if not scene.pads:
        return ()
    forces = sim.tactile()[env].astype(float)
    readings = []
    for pad in scene.pads:
        mount = _pose(sim, env, "pad", f"{pad.name}.markers", pad.pose)
        readings.append(_pad_reading(pad, forces[scene.marker_slice(pad.name)], mount, poses))
    return tuple(readings)


def _pad_reading(pad: PadDef, forces: Array, mount: Pose, poses: Sequence[Pose]) -> PadReading:
    """The reading of a pad; `mount` is its present pose on its body."""
    rotation = pad.pose.matrix()
    on_body = (mount @ pad.pose.inverse()).apply(pad.positions)
    positions = on_body if pad.body == WORLD else poses[pad.body].apply(on_body)
    layout = ((pad.positions - pad.pose.position) @ rotation)[:, :2]
    shear = (np.einsum("mij,mj->mi", pad.axes[:, :, :2], forces[:, :2]) @ rotation)[:, :2]
    return PadReading(pad.name, positions, layout, shear, forces[:, 2])
