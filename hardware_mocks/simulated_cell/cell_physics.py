"""Applies a world to the parameters of the insertion scene; may be applied again while the simulation runs."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.hardware_mocks.simulated_cell.world import World
from gelflow.sim.simulator import Simulator
from gelflow.sim.tasks.parts import Outline, Rectangle

_SIDES = ("left", "right")
_STIFFNESSES = ("kn", "ks", "kt", "kd")  # contact parameters that are proportional to the stiffness of a surface
_WALLS = {"wall_left": ("x", -1), "wall_right": ("x", 1), "wall_front": ("y", -1), "wall_back": ("y", 1)}
_PAD_FACES = 2  # faces of a pad with contact points; the part touches one of them
_INERTIA = ("xx", "yy", "zz", "xy", "xz", "yz")


def pad_overrides(world: World) -> dict[str, Any]:
    """Overrides of the scene for a world with a gel file: the layer, with the printed markers as its cells."""
    gel = world.gels.layer()
    if gel is None:
        return {}
    printed = world.markers
    return {
        "pads.*.rows": printed.rows,
        "pads.*.cols": printed.cols,
        "pads.*.pitch": 1e-3 * printed.pitch_mm,
        "pads.*.center": [1e-3 * c for c in printed.center_mm],
        "pads.*.gel": {name: getattr(gel, name) for name in ("youngs_modulus", "poisson_ratio", "thickness")},
    }


class CellPhysics:
    """The physical parameters of one simulator. The caller holds the cell's lock."""

    def __init__(self, sim: Simulator, world: World, hole: Outline) -> None:
        self._sim = sim
        self._hole = hole
        self._hole_contacts = [name for name in sim.model.contact_names if name.startswith("part_hole")]
        self._nominal: dict[str, float] = {}  # values of the scene file, by parameter
        self.gel_compliance: NDArray[np.float64] = np.ones(2)  # of the left and right gel, relative to the scene's
        self.world = world
        self.apply(world)

    def apply(self, world: World) -> None:
        """Set all parameters for `world`."""
        self.world = world
        for side, stiffness in zip(_SIDES, (world.gels.left, world.gels.right), strict=True):
            self._scale_contact(f"pad_{side}", stiffness, world.friction.pads)
            if world.gels.file:
                self._share_contact(side, world.friction.pads)
            else:
                self._scale_contact(side, stiffness, world.friction.pads)
        self.gel_compliance = 1 / np.array([world.gels.left, world.gels.right])
        if isinstance(self._hole, Rectangle):
            opening = dict(zip("xy", self._hole.half, strict=True))
            for wall, (axis, sign) in _WALLS.items():
                half = float(self._sim.param(f"{wall}.size.{axis}")[0])
                self._set(f"{wall}.shape.pos.{axis}", sign * (half + opening[axis]))
        for contact in self._hole_contacts:
            self._scale_contact(contact, world.hole.stiffness, world.friction.hole)
        self._scale_contact("part_floor", world.hole.stiffness, world.friction.floor)
        for name in ("part.mass", *(f"part.inertia.{axes}" for axes in _INERTIA)):
            self._scale(name, world.part.mass / self._scene_value("part.mass"))
        for name in ("arm_x", "arm_y", "arm_z"):
            self._servo(name, world.arm.stiffness, 1000.0)
        self._servo("arm_yaw", world.arm.yaw_stiffness, 200.0)

    def _scale_contact(self, contact: str, stiffness: float, friction: float) -> None:
        for key in _STIFFNESSES:
            self._scale(f"{contact}.{key}", stiffness)
        self._set(f"{contact}.mu", friction)

    def _share_contact(self, side: str, friction: float) -> None:
        """Give the markers of a pad the stiffness of its contact, so that their forces add up to those of the contact.

        The markers of the scene measure with a stiffness of their own, and policies see normalized flow maps only.
        """
        scene = self._sim.scene
        points = next(len(points.points) for points in scene.points if points.name == f"pad_{side}") / _PAD_FACES
        markers = next(len(pad.positions) for pad in scene.pads if pad.name == side)
        for key in _STIFFNESSES:
            self._set(f"{side}.{key}", float(self._sim.param(f"pad_{side}.{key}")[0]) * points / markers)
        self._set(f"{side}.mu", friction)

    def _servo(self, name: str, stiffness: float, force: float) -> None:
        for key, value in (("kp", stiffness), ("kd", stiffness / 200), ("force_lower", -force), ("force_upper", force)):
            self._set(f"{name}.{key}", value)

    def _scene_value(self, name: str) -> float:
        return self._nominal.setdefault(name, float(self._sim.param(name)[0]))

    def _scale(self, name: str, factor: float) -> None:
        self._set(name, self._scene_value(name) * factor)

    def _set(self, name: str, value: float) -> None:
        self._sim.param(name)[:] = value
