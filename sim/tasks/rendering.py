"""Pictures of an environment: the scene from above and from the side, and the forces on the pads."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.figures import BLUE, GREEN, ORANGE, PURPLE, VERMILION
from gelflow.geometry import Pose
from gelflow.sim.scene import Scene
from gelflow.sim.scene.pads import PadDef
from gelflow.sim.scene.shapes import ShapeDef
from gelflow.sim.simulator import Simulator

Array = NDArray[np.float64]

_BODY_COLORS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE)
_WORLD_COLOR = "0.6"
_MAX_ARROWS = 400  # of a pad; more are thinned out
_SIZE = (9.6, 4.8)  # [in]
_DPI = 80


@dataclass(frozen=True)
class Mark:
    """A line that is drawn into the scene, such as the outline of a goal."""

    points: Array  # in the world [m], (n, 3)
    label: str


def render_scene(
    sim: Simulator, index: int, *, title: str, marks: Sequence[Mark] = (), side: str = "x"
) -> NDArray[np.uint8]:
    """A picture of environment `index` of a simulator whose scene is a `Scene`; shape (height, width, 3).

    Outlines of bodies from above and from the side, and of each pad the shear forces as arrows. `side` is the
    horizontal axis of the view from the side, "x" or "y".
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # deferred: slow to import
    from matplotlib.figure import Figure

    scene: Scene = sim.scene
    figure: Any = Figure(figsize=_SIZE, dpi=_DPI, layout="constrained")
    canvas: Any = FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=11)
    rows = max(1, len(scene.pads))
    left, right = figure.subfigures(1, 2, width_ratios=(3, 1.4 if rows < 3 else 1))
    poses = [Pose(pose[:3].astype(float), pose[3:].astype(float)) for pose in sim.poses()[index]]
    views = {"from above": (0, 1), "from the side": ("xy".index(side), 2)}  # axes of the world in each view
    for axes, (view, plane) in zip(left.subplots(1, 2), views.items(), strict=True):
        _draw_bodies(axes, sim, index, poses, plane)
        for mark in marks:
            axes.plot(*(1e3 * mark.points[:, plane]).T, "k--", linewidth=1.2, label=mark.label)
        names = ["xyz"[axis] for axis in plane]
        axes.set(aspect="equal", title=view, xlabel=f"{names[0]} [mm]", ylabel=f"{names[1]} [mm]")
        axes.margins(0.1)
    if marks:
        left.axes[0].legend(loc="best", fontsize=8)
    forces = sim.tactile()[index]
    for axes, pad in zip(right.subplots(rows, 1, squeeze=False)[:, 0], scene.pads, strict=True):
        _draw_pad(axes, pad, forces[scene.marker_slice(pad.name)])
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]


def _draw_bodies(axes: Any, sim: Simulator, index: int, poses: list[Pose], plane: tuple[int, int]) -> None:
    """Outlines of shapes and of contact points, and lines from each body to its parent, in one view."""
    scene: Scene = sim.scene
    parts: list[tuple[int, Array]] = []  # body, points of its surface in the world
    for shape in scene.shapes:
        if shape.kind != "plane":
            size = [float(sim.param(f"{shape.name}.size.{axis}")[index]) for axis in "xyz"]
            points = shape.pose.apply(_surface(shape, np.array(size)))
            parts.append((shape.body, points))
        elif plane[1] == 2:
            axes.axhline(1e3 * shape.pose.position[2], color=_WORLD_COLOR, linewidth=1)
    drawn = {shape.body for shape in scene.shapes}
    parts += [(cloud.body, cloud.points) for cloud in scene.points if cloud.body not in drawn]
    for owner, points in parts:
        color = _WORLD_COLOR if owner < 0 else _BODY_COLORS[owner % len(_BODY_COLORS)]
        at = points if owner < 0 else poses[owner].apply(points)
        axes.fill(*(1e3 * _hull(at[:, plane])).T, facecolor=color, edgecolor=color, alpha=0.35)
    for number, body in enumerate(scene.bodies):
        ends = [poses[number].apply(pad.pose.position[None])[0] for pad in scene.pads if pad.body == number]
        starts = [poses[body.parent].position] if body.parent >= 0 else []
        for end in [*starts, *ends]:
            line = 1e3 * np.stack([poses[number].position, end])[:, plane]
            axes.plot(*line.T, color=_BODY_COLORS[number % len(_BODY_COLORS)], linewidth=3, solid_capstyle="round")


def _surface(shape: ShapeDef, size: Array) -> Array:
    """Points whose convex hull is the shape, or its bounding box if it is a mesh; in the frame of the shape [m]."""
    angle = np.linspace(0, 2 * np.pi, 33)[:-1]
    if shape.kind in ("sphere", "ellipsoid", "capsule"):
        axes = np.full(3, size[0]) if shape.kind in ("sphere", "capsule") else size
        polar, around = np.meshgrid(np.linspace(0, np.pi, 17), angle)
        unit = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=-1)
        points = unit.reshape(-1, 3) * axes
        if shape.kind != "capsule":
            return np.asarray(points)
        return np.concatenate([points + np.array([0, 0, end * size[1]]) for end in (-1, 1)])
    if shape.kind == "cylinder":
        rim = size[0] * np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
        return np.concatenate([rim + np.array([0, 0, end * size[1]]) for end in (-1, 1)])
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    if shape.grid is None:
        return np.asarray(corners * size)
    extent = shape.grid.spacing * np.array(shape.grid.cells)
    return np.asarray(size * (shape.grid.origin + extent * (corners + 1) / 2))


def _hull(points: Array) -> Array:
    """Corners of the convex hull of points in the plane (n, 2), in order."""
    from scipy.spatial import ConvexHull, QhullError  # deferred: slow to import

    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except QhullError:  # all points are on a line
        return points[np.lexsort(points.T)]


def _draw_pad(axes: Any, pad: PadDef, forces: Array) -> None:
    """Shear forces of the markers as arrows and normal forces as colour, seen from outside, x (to the tip) down."""
    thin = slice(None, None, -(-len(forces) // _MAX_ARROWS))
    rotation = pad.pose.matrix()
    down, right = ((pad.positions - pad.pose.position) @ rotation)[thin, :2].T * 1e3
    shear = np.einsum("mij,mj->mi", pad.axes[:, :, :2], forces[:, :2]) @ rotation
    arrows = shear[thin, :2]
    largest = float(np.hypot(*arrows.T).max(initial=0.0))
    normal = forces[thin, 2]
    colors = {"c": normal, "cmap": "Greys", "vmin": 0, "vmax": max(1e-6, normal.max(initial=0))}
    axes.scatter(right, down, s=8, edgecolors="0.8", linewidths=0.3, **colors)
    if largest > 0:
        length = 0.9 * float(np.sqrt(np.ptp(down) * np.ptp(right) / len(down))) / largest  # about the pitch
        axes.quiver(right, down, *(arrows[:, ::-1] * length).T, color=BLUE, angles="xy", scale_units="xy", scale=1)
    axes.set(aspect="equal", xticks=[], yticks=[])
    axes.set_title(f"{pad.name}: shear to {1e3 * largest:.3g} mN, normal {forces[:, 2].sum():.3g} N", fontsize=9)
    axes.invert_yaxis()
    axes.margins(0.15)
