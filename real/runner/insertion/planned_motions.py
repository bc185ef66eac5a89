"""A motion plan on the robot: its check against the lab file before anything moves, and the policy that plays it."""

import math

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.geometry import rotated
from gelflow.observation import FlowMap
from gelflow.real.runner.lab import Lab
from gelflow.session.motion_plan import PlannedMotion
from gelflow.task import InsertionTask


class PlanPolicy:
    """The corrections from each pose of a plan to the next one, whatever is observed. Implements `Policy`."""

    def __init__(self, motions: tuple[PlannedMotion, ...]) -> None:
        self.motions = motions
        self._made = 0

    def reset(self) -> None:
        """Start the plan again, at its first pose."""
        self._made = 0

    def act(self, observation: FlowMap) -> NDArray[np.float64]:
        """The correction (dx [m], dy [m], dyaw [rad]) in the gripper frame to the next pose; zero after the last."""
        before = np.array(self.motions[self._made].planar_pose)
        self._made = min(self._made + 1, len(self.motions) - 1)
        change = np.array(self.motions[self._made].planar_pose) - before
        return np.array([*rotated(change[:2], -before[2]), change[2]])


def check_motions(motions: tuple[PlannedMotion, ...], lab: Lab, task: InsertionTask) -> None:
    """Raise UsageError, which names the motion and the limit, when a motion exceeds those of the lab or the task."""
    space = lab.workspace
    of_lab = (space.x, space.y, math.radians(space.yaw_deg))
    largest = tuple(min(pair) for pair in zip(of_lab, task.workspace, strict=True))
    x, y, yaw = largest
    for number, motion in enumerate(motions):
        shear = lab.descent.contact_shear_mm, lab.descent.largest_stop_shear_mm
        if beyond := motion.beyond((x, y, yaw), task.descent, shear):
            raise UsageError(
                f"motion {number + 1} of the plan: {beyond}; the limits are those of the lab file and the task: write "
                "a plan within them with gelflow calibrate --plan FILE --lab LAB"
            )
