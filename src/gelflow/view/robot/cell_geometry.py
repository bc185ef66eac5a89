"""Geometry of a robot cell, from the description of a session."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gelflow.errors import PeerError, UsageError
from gelflow.geometry import Pose, yaw_quaternion
from gelflow.task import InsertionTask


@dataclass(frozen=True)
class CellGeometry:
    """The parts of a cell that a page draws, and from which heights are measured."""

    task: InsertionTask
    tool: Pose  # the gripper frame in the frame of the flange
    hole: Pose | None  # the taught hole in the base frame; None where the session has no lab file
    grasp_height: float  # of the gripper frame above the part's lower face [m]
    open_width: float  # of the gripper [m]

    @classmethod
    def of(cls, description: Mapping[str, Any]) -> "CellGeometry":
        """The geometry in a session's description. Raises PeerError when the description is incomplete."""
        try:
            task = InsertionTask.from_json(dict(description["task"]))
            lab = description.get("lab") or {}
            if not lab:
                down = Pose(np.zeros(3), np.array([0.0, 1.0, 0.0, 0.0]))
                return cls(task, down, None, task.part.size[2] / 2, task.part.size[0])
            tool, hole = lab["tool"], lab["hole"]
            turn = np.array(tool["quaternion"], dtype=float)
            return cls(
                task,
                Pose(np.array(tool["position"], dtype=float), turn / np.linalg.norm(turn)),
                Pose(np.array(hole["position"], dtype=float), yaw_quaternion(np.radians(float(hole["yaw_deg"])))),
                float(lab["part"]["grasp_height"]),
                float(lab["gripper"]["open_width"]),
            )
        except (KeyError, TypeError, ValueError, UsageError) as error:
            raise PeerError(f"the session's description of the cell is incomplete: {error}") from error

    def gripper(self, flange: Pose) -> Pose:
        """The gripper frame in the base frame: between the pad centres, z up."""
        return flange @ self.tool

    def part_height(self, flange: Pose) -> float:
        """Height of the lower face of a grasped part above the hole's floor, without a lab file above the base [m]."""
        gripper = self.gripper(flange)
        local = gripper if self.hole is None else self.hole.inverse() @ gripper
        return float(local.position[2]) - self.grasp_height
