"""One environment on a page: bodies, contact forces, pads with their markers and panels."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.sim.drawing.annotations import (
    FORCE_COLOR,
    ForceScales,
    force_scales,
    marker_colors,
    pad_panel,
    quantity,
    round_scale,
)
from gelflow.sim.drawing.camera import framing_camera
from gelflow.sim.drawing.ray_caster import body_colors
from gelflow.sim.drawing.scene_drawing import ContactForce, PadReading, SceneDrawing
from gelflow.sim.scene import Scene
from gelflow.sim.scene.mjcf.mechanics import WORLD, GeomDef
from gelflow.view.geometry_meshes import has_edges, triangles
from gelflow.view.page import Page

Array = NDArray[np.float64]

PANEL_SIZE = (260, 340)  # of a pad [px]
_LONGEST_FORCE = 0.16  # arrow of the largest contact force, in distances of the camera
_LONGEST_SHEAR = 0.04  # the same of the shear force of a marker
_SHEAR_COLOR = (20, 20, 20)
_GAMMA = 2.2  # of sRGB, about
_MAX_SHEAR_ARROWS = 800  # per pad
_OPACITY, _OPACITY_WORLD = 0.5, 0.4  # arrows of forces start at faces and often lie inside of a body
_LABELS = 8  # of the largest contact forces
_LABEL_INTERVAL = 0.3  # [s]
_PANELS_PER_ROW = 2
_TILES = 4  # lines of a plane over the height of the view, about


@dataclass
class Shown:
    """The contents shown in addition to the bodies."""

    contacts: bool = True
    labels: bool = True
    markers: bool = True


class SceneView:
    """The nodes of a page that show drawings of one scene.

    Parameters
    ----------
    page: where the nodes are made
    scene: scene of the drawings
    drawing: at the start of the scene; the camera of the page frames it
    clicked: called with the number of a body when it is clicked, `WORLD` for the fixed geometries
    root: prefix of the names of the nodes
    """

    def __init__(
        self,
        page: Page,
        scene: Scene,
        drawing: SceneDrawing,
        *,
        clicked: Callable[[int], None] | None = None,
        root: str = "/scene",
    ) -> None:
        self._page, self._scene, self._root, self._clicked = page, scene, root, clicked
        self.shown = Shown()
        self._camera = framing_camera([drawing])
        self._key: tuple[bytes, ...] = ()
        self.scales: ForceScales = force_scales([])
        self._seen = [0.0, 0.0, 0.0]  # largest forces so far, in the order of ForceScales
        distance = self._camera.distance
        arrows = np.zeros((1, 2, 3))
        self._arrows = page.scene.add_arrows(
            f"{root}/contact forces", arrows, _linear(FORCE_COLOR), shaft_radius=0.003 * distance,
            head_radius=0.008 * distance, head_length=0.02 * distance, visible=False,
        )  # fmt: skip
        self._labels: dict[str, Any] = {}  # by contact, so that their texts change little
        self._label_due = 0.0
        self._pads = {pad.name: self._add_pad(pad) for pad in drawing.pads}
        self._make_bodies(drawing)
        self._set_camera()

    def reset_scales(self) -> None:
        """Reset the scales of forces; they grow with the forces and never shrink by themselves."""
        self._seen = [0.0, 0.0, 0.0]

    def show(self, drawing: SceneDrawing) -> None:
        """Show a drawing."""
        self._update_scales(drawing)
        with self._page.server.atomic():
            if _geometry_key(drawing) != self._key:
                self._make_bodies(drawing)
            for node, pose in zip(self._bodies, drawing.poses, strict=True):
                node.position, node.wxyz = pose.position, pose.quaternion
            self._show_contacts(drawing)
            for pad in drawing.pads:
                self._show_pad(pad, drawing)

    def legend(self) -> str:
        """Scales of the forces in words, as Markdown."""
        if not self._scene.contacts and not self._pads:
            return "The scene has no contacts, so bodies pass through each other; a TOML file lists contacts."
        lines = [f"Contact force, orange arrow: {quantity(self.scales.contact, 'N')} is the longest."]
        if self._pads:
            lines.append(
                f"Pad markers: colour is the normal force, grey 0 to dark {quantity(self.scales.normal, 'N')}; black "
                f"line is the shear force of the object on the pad, {quantity(self.scales.shear, 'N')} the longest."
            )
        return "\n\n".join(lines)

    def panels(self, drawing: SceneDrawing) -> NDArray[np.uint8]:
        """The panels of all pads in one picture, (height, width, 3)."""
        pictures = [pad_panel(pad, self.scales, PANEL_SIZE) for pad in drawing.pads]
        columns = min(_PANELS_PER_ROW, len(pictures))
        blank = np.full_like(pictures[0], 255)
        pictures += [blank] * (-len(pictures) % columns)
        rows = [np.hstack(pictures[i : i + columns]) for i in range(0, len(pictures), columns)]
        return np.vstack(rows)

    def _update_scales(self, drawing: SceneDrawing) -> None:
        now = (
            [float(np.linalg.norm(contact.force)) for contact in drawing.contacts],
            [float(pad.normal.max(initial=0)) for pad in drawing.pads],
            [float(np.linalg.norm(pad.shear, axis=1).max(initial=0)) for pad in drawing.pads],
        )
        self._seen = [max(seen, *values, 0.0) for seen, values in zip(self._seen, now, strict=True)]
        self.scales = ForceScales(*(round_scale(value) for value in self._seen))

    def _set_camera(self) -> None:
        camera, initial = self._camera, self._page.server.initial_camera
        initial.up = (0.0, 0.0, 1.0)
        initial.position, initial.look_at = camera.position, np.array(camera.target)
        initial.fov = float(np.radians(camera.fov))
        initial.near = 0.01 * camera.distance

    def _make_bodies(self, drawing: SceneDrawing) -> None:
        """Frames of the bodies and their geometries, in place of earlier ones."""
        scene, self._key = self._page.scene, _geometry_key(drawing)
        names = [f"{number} {_node(body.name)}" for number, body in enumerate(self._scene.bodies)]
        self._bodies = [scene.add_frame(f"{self._root}/bodies/{name}", show_axes=False) for name in names]
        scene.add_frame(f"{self._root}/bodies/world", show_axes=False)
        for number, geom in enumerate(drawing.geoms):
            self._add_geom(number, geom, "world" if geom.body == WORLD else names[geom.body])

    def _add_geom(self, number: int, geom: GeomDef, body: str) -> None:
        name = f"{self._root}/bodies/{body}/{number} {_node(geom.name)}"
        pose = {"position": geom.pose.position, "wxyz": geom.pose.quaternion}
        if geom.kind == "plane":
            size, tile = 7 * self._camera.distance, round_scale(self._camera.distance / _TILES / 2)
            self._page.scene.add_grid(
                name, size, size, cell_size=tile, section_size=5 * tile, plane_opacity=0.6, plane_color=(238, 238, 234),
                cell_color=(205, 205, 205), section_color=(170, 170, 170), **pose,
            )  # fmt: skip
            return
        vertices, faces = triangles(geom)
        color = tuple(int(c) for c in body_colors(np.array([geom.body]))[0])
        node = self._page.scene.add_mesh_simple(
            name, vertices, faces, color=color, flat_shading=has_edges(geom), side="double",
            opacity=_OPACITY_WORLD if geom.body == WORLD else _OPACITY, **pose,
        )  # fmt: skip
        clicked = self._clicked
        if clicked is not None:
            node.on_click(lambda _: clicked(geom.body))

    def _add_pad(self, pad: PadReading) -> tuple[Any, Any]:
        distance, count = self._camera.distance, max(len(pad.positions), 1)
        pitch = float(np.sqrt(max(np.prod(np.ptp(pad.layout, axis=0)), 1e-12) / count))
        cloud = self._page.scene.add_point_cloud(
            f"{self._root}/pads/{pad.name}/markers", np.zeros((1, 3)), np.zeros((1, 3), dtype=np.uint8),
            point_size=min(0.6 * pitch, 0.012 * distance), point_shape="circle", precision="float32",
            point_shading="flat",
        )  # fmt: skip
        shear = self._page.scene.add_line_segments(
            f"{self._root}/pads/{pad.name}/shear", np.zeros((1, 2, 3)), _SHEAR_COLOR,
            thickness=1.5, thickness_units="screen", visible=False,
        )  # fmt: skip
        return cloud, shear

    def _show_contacts(self, drawing: SceneDrawing) -> None:
        contacts = sorted(drawing.contacts, key=lambda contact: -float(np.linalg.norm(contact.force)))
        length = _LONGEST_FORCE * self._camera.distance / self.scales.contact
        visible = self.shown.contacts and bool(contacts)
        if visible:
            self._arrows.points = np.array([[c.point, c.point + length * c.force] for c in contacts], dtype=np.float32)
        self._arrows.visible = visible
        self._show_labels(contacts[:_LABELS] if visible and self.shown.labels else [], length)

    def _show_labels(self, contacts: list[ContactForce], length: float) -> None:
        """Labels at the heads of the arrows; browsers need time for a changed text, so it changes rarely."""
        now = time.monotonic()
        due = now >= self._label_due
        if due:
            self._label_due = now + _LABEL_INTERVAL
        named = {contact.name: contact for contact in contacts}
        for name, label in self._labels.items():
            if label.visible != (name in named):
                label.visible = name in named
        for name, contact in named.items():
            tip = contact.point + length * contact.force
            text = f"{name}: {quantity(float(np.linalg.norm(contact.force)), 'N')}"
            if name not in self._labels:
                path = f"{self._root}/force labels/{len(self._labels)} {_node(name)}"
                self._labels[name] = self._page.scene.add_label(path, text, position=tip, font_screen_scale=0.9)
            elif due and self._labels[name].text != text:
                self._labels[name].text = text
            self._labels[name].position = tip

    def _show_pad(self, pad: PadReading, drawing: SceneDrawing) -> None:
        cloud, shear = self._pads[pad.name]
        cloud.visible = self.shown.markers
        if not self.shown.markers:
            shear.visible = False
            return
        cloud.points = pad.positions.astype(np.float32)
        cloud.colors = marker_colors(pad.normal / self.scales.normal)
        length = _LONGEST_SHEAR * self._camera.distance / self.scales.shear
        strongest = np.argsort(-np.linalg.norm(pad.shear, axis=1))[:_MAX_SHEAR_ARROWS]
        axes = self._pad_axes(pad.name, drawing)
        ends = pad.positions[strongest] + length * pad.shear[strongest] @ axes.T
        shear.points = np.stack([pad.positions[strongest], ends], axis=1).astype(np.float32)
        shear.visible = True

    def _pad_axes(self, name: str, drawing: SceneDrawing) -> Array:
        """Directions of x and y of a pad's site in the world, as columns (3, 2)."""
        pad = next(pad for pad in self._scene.pads if pad.name == name)
        rotation = pad.pose.matrix() if pad.body == WORLD else (drawing.poses[pad.body] @ pad.pose).matrix()
        return np.asarray(rotation[:, :2])


def _geometry_key(drawing: SceneDrawing) -> tuple[bytes, ...]:
    return tuple(
        part.tobytes() for geom in drawing.geoms for part in (geom.size, geom.pose.position, geom.pose.quaternion)
    )


def _node(name: str) -> str:
    """A name as that of a node; viser would draw "a/b" relative to "a"."""
    return name.replace("/", " ")


def _linear(color: tuple[int, int, int]) -> tuple[int, int, int]:
    """A colour in linear light: viser takes the colours of arrows as such, unlike all others."""
    red, green, blue = (round(255 * (c / 255) ** _GAMMA) for c in color)
    return red, green, blue
