"""Arm, gripper, grasped part and hole of one robot in the 3D view of a page."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from gelflow.geometry import Pose
from gelflow.real.kinematics import DH, link_frames
from gelflow.sim.tasks.parts import shipped_mesh
from gelflow.view.page import Page
from gelflow.view.robot.cell_geometry import CellGeometry

Color = tuple[int, int, int]
PAD_COLORS: tuple[Color, Color] = ((0, 114, 178), (213, 94, 0))  # left and right pad, as their curves
_ARM, _GRIPPER, _FINGER, _PART, _HOLE = (214, 216, 220), (90, 94, 102), (60, 62, 68), (222, 190, 120), (150, 152, 156)
_LINK_RADII = (0.06, 0.05, 0.048, 0.042, 0.034, 0.028)  # of capsules that stand for the links [m]
_PALM = (0.146, 0.05, 0.072)  # housing of the gripper [m]
_FINGER_SIZE = (0.012, 0.024)  # thickness and width of a finger [m]
_PAD_SIZE = (0.003, 0.020, 0.026)  # of a gel pad [m]
_BELOW_PAD = 0.014  # length of a finger below the centre of its pad [m]
_ASIDE = 0.22  # of the centre of the view from that of the robot [m]
_WALL = 0.006  # thickness of the walls that stand for the hole [m]


class RobotView:
    """Nodes of a page that show one robot.

    Parameters
    ----------
    page: where the nodes are made
    cell: geometry of the cell
    root: prefix of the names of the nodes
    opacity: of everything; less than 1 tells a second robot from the first
    """

    def __init__(self, page: Page, cell: CellGeometry, *, root: str = "/robot", opacity: float = 1.0) -> None:
        self._page, self._cell, self._root = page, cell, root
        self._opacity = None if opacity == 1 else opacity
        self._node = page.scene.add_frame(root, show_axes=False)
        self._links = [page.scene.add_frame(f"{root}/arm/{k}", show_axes=False, visible=False) for k in range(1, 7)]
        self._gripper = page.scene.add_frame(f"{root}/gripper", show_axes=False, visible=False)
        self._add_arm()
        self._box("gripper/palm", _PALM, (0.0, 0.0, self._palm_height() + _PALM[2] / 2), _GRIPPER)
        self._fingers = [self._add_finger(sensor) for sensor in range(2)]
        self._part = self._add_part()
        self._add_hole()
        self._frame_camera()

    def show(
        self, joints: Sequence[float] | None, flange: Pose | None, width: float | None, *, part_held: bool
    ) -> None:
        """Show a state: joint angles [rad], the flange in the base frame, the width of the gripper [m].

        Without joint angles only the gripper is shown, without a pose of the flange nothing.
        """
        with self._page.server.atomic():
            for node in self._links:
                node.visible = joints is not None
            if joints is not None:
                for node, (position, quaternion) in zip(self._links, link_frames(joints), strict=True):
                    node.position, node.wxyz = position, quaternion
            self._gripper.visible = flange is not None
            if flange is not None:
                pose = self._cell.gripper(flange)
                self._gripper.position, self._gripper.wxyz = pose.position, pose.quaternion
            opening = self._cell.open_width if width is None else width
            for node, side in zip(self._fingers, (-1, 1), strict=True):
                node.position = (side * opening / 2, 0.0, 0.0)
            self._part.visible = part_held

    def remove(self) -> None:
        """Remove the robot from the page."""
        self._node.remove()

    def _add_arm(self) -> None:
        self._cylinder("arm/base", 0.08, 0.12, (0.0, 0.0, 0.06), _ARM)
        for k, ((_, d, a, twist), radius) in enumerate(zip(DH, _LINK_RADII, strict=True), start=1):
            # In the frame after joint k: its x axis carries a, the axis of joint k (tilted by the twist) carries d.
            axis = np.array([0.0, np.sin(twist), np.cos(twist)])
            elbow = np.array([-a, 0.0, 0.0])
            foot = _LINK_RADII[0] if k == 1 else 0.0  # the first capsule ends within the base
            for name, start, end in (("d", elbow - (d - foot) * axis, elbow), ("a", elbow, np.zeros(3))):
                if np.linalg.norm(end - start) > 1e-6:
                    self._capsule(f"arm/{k}/{name}", start, end, radius)

    def _capsule(self, name: str, start: Any, end: Any, radius: float) -> None:
        import trimesh  # deferred: comes with viser

        length = float(np.linalg.norm(end - start))
        library: Any = trimesh
        shape = library.creation.capsule(radius=radius, height=length, count=(16, 16))
        shape.apply_transform(library.geometry.align_vectors([0.0, 0.0, 1.0], (end - start) / length))
        shape.apply_translation((start + end) / 2)
        self._mesh(name, np.asarray(shape.vertices), np.asarray(shape.faces), _ARM, smooth=True)

    def _mesh(self, name: str, vertices: Any, faces: Any, color: Color, smooth: bool = False) -> None:
        self._page.scene.add_mesh_simple(
            f"{self._root}/{name}", vertices, faces, color=color, opacity=self._opacity, side="double",
            flat_shading=not smooth,
        )  # fmt: skip

    def _palm_height(self) -> float:
        """Height of the lower face of the gripper's housing, which touches the flange, above the pad centres [m]."""
        return float(np.linalg.norm(self._cell.tool.position)) - _PALM[2]

    def _add_finger(self, sensor: int) -> Any:
        thickness, breadth = _FINGER_SIZE
        node = self._page.scene.add_frame(f"{self._root}/gripper/finger {sensor}", show_axes=False)
        side, height = (-1, 1)[sensor], max(self._palm_height(), 0.02) + _BELOW_PAD
        outside = side * (thickness / 2 + _PAD_SIZE[0])
        self._box(
            f"gripper/finger {sensor}/body", (thickness, breadth, height), (outside, 0.0, height / 2 - _BELOW_PAD),
            _FINGER,
        )  # fmt: skip
        self._box(f"gripper/finger {sensor}/pad", _PAD_SIZE, (side * _PAD_SIZE[0] / 2, 0.0, 0.0), PAD_COLORS[sensor])
        return node

    def _add_part(self) -> Any:
        node = self._page.scene.add_frame(f"{self._root}/gripper/part", show_axes=False, visible=False)
        part = self._cell.task.part
        height = part.size[2] / 2 - self._cell.grasp_height
        mesh = shipped_mesh(part)
        if mesh is not None:
            self._mesh("gripper/part/body", mesh.vertices + np.array([0.0, 0.0, height]), mesh.faces, _PART)
        elif part.shape == "cylinder":
            self._cylinder("gripper/part/body", part.size[0] / 2, part.size[2], (0.0, 0.0, height), _PART)
        else:
            self._box("gripper/part/body", part.size, (0.0, 0.0, height), _PART)
        return node

    def _add_hole(self) -> None:
        if self._cell.hole is None:
            return
        hole, part, depth = self._cell.hole, self._cell.task.part, self._cell.task.rim_height
        self._page.scene.add_frame(
            f"{self._root}/hole", show_axes=False, position=hole.position, wxyz=hole.quaternion
        )  # fmt: skip
        inner = np.array(part.size[:2]) + part.clearance
        for name, axis, side in (("-x", 0, -1), ("+x", 0, 1), ("-y", 1, -1), ("+y", 1, 1)):
            size = np.array([inner[0] + 2 * _WALL, inner[1] + 2 * _WALL, depth])
            size[axis] = _WALL
            middle = np.array([0.0, 0.0, depth / 2])
            middle[axis] = side * (inner[axis] + _WALL) / 2
            self._box(f"hole/{name}", tuple(size), tuple(middle), _HOLE)
        self._box("hole/floor", (inner[0], inner[1], 0.002), (0.0, 0.0, -0.001), _HOLE)

    def _box(self, name: str, size: Sequence[float], middle: Sequence[float], color: Color) -> None:
        self._page.scene.add_box(
            f"{self._root}/{name}", color, dimensions=tuple(size), position=tuple(middle), opacity=self._opacity
        )

    def _cylinder(self, name: str, radius: float, height: float, middle: Sequence[float], color: Color) -> None:
        self._page.scene.add_cylinder(
            f"{self._root}/{name}", radius, height, color, position=tuple(middle), opacity=self._opacity
        )

    def _frame_camera(self) -> None:
        target = np.array([0.2, 0.0, 0.25])
        if self._cell.hole is not None:
            target = target + self._cell.hole.position * (0.6, 0.5, 0.0)
        initial = self._page.server.initial_camera
        initial.up = (0.0, 0.0, 1.0)
        away = np.array([0.65, -0.85, 0.3])
        right = np.array([-away[1], away[0], 0.0]) / np.hypot(away[0], away[1])
        target = target + _ASIDE * right  # the controls cover the right side of the view
        initial.position, initial.look_at = target + away, target
        initial.near = 0.01
