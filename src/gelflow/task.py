"""The insertion task, described once: the simulated environment and the robot's runner read the same numbers.

The description is stored in every checkpoint; a checkpoint refuses to run under another one.
"""

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.observation import Grid

_POLICY_GRID = Grid(rows=13, cols=10, pitch=1.5, center=(2.0, 0.0))


@dataclass(frozen=True)
class InsertionTask:
    """Insertion of a cuboid into a hole, with corrections by touch. Lengths in metres, angles in radians."""

    format: int = 1
    name: str = "insertion"
    sensors: int = 2  # tactile pads; 0 is the left finger
    grid: Grid = _POLICY_GRID  # what the policy sees of each pad [mm]
    # Frames are picked by depth below the start of an attempt, never by time: simulation descends faster.
    reference_depth: float = 0.0  # the frame that all others are compared with
    frame_depths: tuple[float, ...] = (1.1e-3,)  # the frames that make the observation
    descent: float = 1.1e-3  # how far an attempt lowers the gripper unless it feels the hole's floor
    start_height: float = 25.5e-3  # the part's lower face above the hole's floor when an attempt starts
    rim_height: float = 25.0e-3  # the hole's rim above its floor
    success_height: float = 24.7e-3  # lower face below this: inserted
    attempts: int = 15
    action_scale: tuple[float, float, float] = (20e-3, 20e-3, np.pi / 18)  # action ±1 means this: x, y, yaw
    workspace: tuple[float, float, float] = (15e-3, 15e-3, np.pi / 12)  # |x|, |y|, |yaw| of the gripper, at most
    misalignment: tuple[float, float, float] = (6e-3, 6e-3, np.pi / 18)  # uniform within ±, at the start

    def to_json(self) -> dict[str, Any]:
        """As plain data, for checkpoints and recordings."""
        return json.loads(json.dumps(dataclasses.asdict(self)))  # type: ignore[no-any-return]

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> "InsertionTask":
        """The reverse of `to_json`. Raises UsageError on unknown keys or a newer format."""
        if data.get("format", 0) > 1:
            raise UsageError(f"task description has format {data['format']}; this gelflow reads format 1")
        known = {field.name for field in dataclasses.fields(cls)}
        if unknown := set(data) - known:
            raise UsageError(f"task description has unknown keys {sorted(unknown)}; known are {sorted(known)}")
        values: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value for key, value in data.items()
        }
        if isinstance(grid := values.get("grid"), dict):
            values["grid"] = Grid(**{**grid, "center": tuple(grid["center"])})
        return cls(**values)

    def digest(self) -> str:
        """A short fingerprint: equal exactly when two descriptions are equal."""
        return hashlib.sha256(json.dumps(self.to_json(), sort_keys=True).encode()).hexdigest()[:16]

    @property
    def observation_shape(self) -> tuple[int, int, int]:
        """Shape of the flow map's image: (frames * sensors * 2, rows, cols)."""
        return (len(self.frame_depths) * self.sensors * 2, self.grid.rows, self.grid.cols)

    def correction(self, action: NDArray[np.float64]) -> NDArray[np.float64]:
        """A policy's output in ±1 as (dx [m], dy [m], dyaw [rad]) in the gripper's frame; clipped to ±1."""
        return np.asarray(np.clip(np.asarray(action, dtype=float), -1, 1) * np.asarray(self.action_scale))

    def corrected(self, pose: NDArray[np.float64], correction: NDArray[np.float64]) -> NDArray[np.float64]:
        """The pose after a correction, limited to the workspace: one rule for simulation and robot.

        `pose` is (x [m], y [m], yaw [rad]) of the gripper in the hole's frame, shape (…, 3): z up, yaw about it.
        `correction` is (dx, dy, dyaw) in the gripper's frame, whose x runs from the left finger to the right one and
        whose z is the hole's. Where a correction would leave the workspace, each of x, y, yaw stops at its limit.
        """
        pose, correction = np.asarray(pose, dtype=float), np.asarray(correction, dtype=float)
        cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
        moved = np.stack(
            [
                pose[..., 0] + cos * correction[..., 0] - sin * correction[..., 1],
                pose[..., 1] + sin * correction[..., 0] + cos * correction[..., 1],
                pose[..., 2] + correction[..., 2],
            ],
            axis=-1,
        )
        limit = np.asarray(self.workspace)
        return np.asarray(np.clip(moved, -limit, limit))

    def reward(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """Reward of gripper poses in the hole's frame, shape (…, 3) [m, m, rad]: −1e4 ‖(x, y)‖² − 20 yaw² (eq. 27)."""
        pose = np.asarray(pose, dtype=float)
        return np.asarray(-1e4 * (pose[..., :2] ** 2).sum(-1) - 20 * pose[..., 2] ** 2)

    def draw_misalignment(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Where `count` episodes start: (x [m], y [m], yaw [rad]) in the hole's frame, shape (count, 3)."""
        limit = np.asarray(self.misalignment)
        return rng.uniform(-limit, limit, (count, 3))


INSERTION = InsertionTask()
