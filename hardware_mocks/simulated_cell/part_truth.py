"""Ground truth of one part: its pose, its slip in the grip, and the contact forces on it."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.geometry import Pose
from gelflow.sim.tasks.parts import Outline

Array = NDArray[np.float64]

_AT_REST = (2e-6, math.radians(2e-3), 0.05)  # a tool that moves less than this [m, rad] for this time [s] is at rest
_INTO_WALL = 0.3e-3  # largest penetration of an inserted part into a wall of the hole [m]


@dataclass
class PartTruth:
    """Ground truth of one part. Slips are displacements of the gripped point of the part relative to the gripper."""

    seed: int
    misalignment: tuple[float, float, float]  # of the gripper at the taught pose, in the hole's frame [m, m, rad]
    phase: str = "presented"  # presented, gripped, released
    height: float = 0.0  # of the lower face's highest corner above the hole's floor, when last held [m]
    x: float = 0.0  # of the part in the hole frame [m]
    y: float = 0.0
    yaw: float = 0.0  # [rad]
    slip: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the part relative to the gripper frame [m, m, rad]
    inserted: bool = False  # in the hole when last held
    largest_slip: float = 0.0  # since the grasp [m]
    largest_vertical_slip: float = 0.0  # since the grasp, along the gripper's z axis [m]
    largest_push: float = 0.0  # increase of the slip while the arm moved, since it was last at rest [m]
    slip_at_rest: float = 0.0  # when the arm was last at rest [m]
    largest_force: float = 0.0  # of hole and floor on the part while it was held [N]


def is_inside(corners: Array, hole: Outline) -> bool:
    """Whether corners of the lower face in the hole frame (n, 3) [m] are within the outline of the hole."""
    return bool((hole.distance(corners[:, :2]) < _INTO_WALL).all())


class SlipMonitor:
    """Measures the slip of a gripped part in every step, from the grasp to the release."""

    def __init__(self, truth: PartTruth, *, gripper: Pose, part: Pose) -> None:
        self._truth = truth
        self._gripped = part.inverse().apply(gripper.position)  # the point of the part between the pads
        self._rest_slip = np.zeros(3)
        self._tool: Pose | None = None  # the tool's pose when it last moved
        self._moved = 0.0  # time of that motion [s]

    def update(self, now: float, *, tool: Pose, gripper: Pose, part: Pose, force: float) -> None:
        """Update the truth at time `now` [s] with the force of hole and floor on the part [N]."""
        truth = self._truth
        slip = gripper.inverse().apply(part.apply(self._gripped))
        size = float(np.linalg.norm(slip))
        truth.largest_slip = max(truth.largest_slip, size)
        truth.largest_vertical_slip = max(truth.largest_vertical_slip, abs(float(slip[2])))
        truth.largest_force = max(truth.largest_force, force)
        if self._is_at_rest(now, tool):
            self._rest_slip, truth.slip_at_rest = slip, size
        elif size > truth.slip_at_rest:  # a slip that decreases is the elastic recovery of the gels
            truth.largest_push = max(truth.largest_push, float(np.linalg.norm(slip - self._rest_slip)))

    def _is_at_rest(self, now: float, tool: Pose) -> bool:
        distance, angle, seconds = _AT_REST
        if self._tool is None or not tool.is_near(self._tool, distance, angle):
            self._tool, self._moved = tool, now
        return now - self._moved > seconds
