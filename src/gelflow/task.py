"""Descriptions of tasks: the base, and the insertion task, which the simulation and the robot's runner share.

Every checkpoint contains the description of its task; a policy cannot be loaded for another description.
Equation numbers are those of Xu et al., Efficient Tactile Simulation with Differentiability for Robotic Manipulation,
CoRL 2022.
"""

import dataclasses
import hashlib
import json
import math
import numbers
from dataclasses import dataclass
from typing import Any, Self, get_args

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.geometry import compose_planar, rotated
from gelflow.observation import Grid
from gelflow.part import CUBOID, Part

_START_ABOVE_RIM = 0.5e-3  # [m] of the lower face at the start of an attempt
_SUCCESS_BELOW_RIM = 0.3e-3  # [m]
# [m] of an attempt, unless contact ends it. With the published 1.1 mm it ends 0.6 mm below the rim, where an arm of 0.2
# N/mm presses with 0.1 N: the markers hardly move, and the policy learns little from it.
_DESCENT = 4.1e-3

OBSERVATIONS = ("flow map", "forces", "nothing")

_POLICY_GRID = Grid(rows=13, cols=10, pitch=1.5, center=(2.0, 0.0))


@dataclass(frozen=True)
class TaskDescription:
    """Description of a task: a frozen dataclass of numbers, strings, tuples and marker grids; a subclass per task.

    Lengths in metres, angles in radians.
    """

    format: int = 1
    name: str = ""

    def __post_init__(self) -> None:
        """Raises UsageError for a value of another type than the default, and for a number that is not finite."""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if (expected := _expected(field, value)) is not None:
                raise UsageError(f"{field.name} must be {expected}, got {' '.join(repr(value).split())}")

    def to_json(self) -> dict[str, Any]:
        """As plain data, for checkpoints and recordings."""
        return json.loads(json.dumps(dataclasses.asdict(self)))  # type: ignore[no-any-return]

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Self:
        """Inverse of `to_json`. Raises UsageError on unknown keys, another task or a newer format."""
        if data.get("format", 0) > 1:
            raise UsageError(f"task description has format {data['format']}; this gelflow reads format 1")
        known = {field.name: field.default for field in dataclasses.fields(cls)}
        if unknown := set(data) - set(known):
            raise UsageError(f"task description has unknown keys {sorted(unknown)}; known are {sorted(known)}")
        if known["name"] and data.get("name", known["name"]) != known["name"]:
            raise UsageError(f"task description is of {data['name']!r}, expected {known['name']!r}")
        values: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value for key, value in data.items()
        }
        if isinstance(grid := values.get("grid"), dict):
            values["grid"] = Grid(**{**grid, "center": tuple(grid["center"])})
        return cls(**values)

    def digest(self) -> str:
        """A short hash: equal for equal descriptions."""
        return hashlib.sha256(json.dumps(self.to_json(), sort_keys=True).encode()).hexdigest()[:16]

    def check_positive(self, *names: str) -> None:
        """Raise UsageError for the first of these fields with a number that is not above 0."""
        for name in names:
            if np.any(np.asarray(value := getattr(self, name)) <= 0):
                raise UsageError(f"{name} must be above 0, got {value}")

    def check_not_negative(self, *names: str) -> None:
        """Raise UsageError for the first of these fields with a negative number."""
        for name in names:
            if np.any(np.asarray(value := getattr(self, name)) < 0):
                raise UsageError(f"{name} must not be negative, got {value}")

    def check_ordered(self, *names: str) -> None:
        """Raise UsageError for the first of these ranges (low, high) whose low end is above the high one."""
        for name in names:
            low, high = getattr(self, name)
            if low > high:
                raise UsageError(f"{name} must be (low, high), got {(low, high)}")


def _expected(field: "dataclasses.Field[Any]", value: Any) -> str | None:
    """The type and range that a value should have and has not, by the default of its field; None if it has them."""
    default = field.default
    if isinstance(default, tuple):
        if not isinstance(value, tuple | list) or not all(_is_finite(number) for number in value):
            return "a tuple of finite numbers"
        any_count = get_args(field.type)[-1] is Ellipsis
        return None if any_count or len(value) == len(default) else f"a tuple of {len(default)} numbers"
    if isinstance(default, bool) or not isinstance(default, int | float):
        return None if default is None or isinstance(value, type(default)) else f"a {type(default).__name__}"
    if isinstance(default, int):
        return None if isinstance(value, numbers.Integral) and not isinstance(value, bool) else "an integer"
    return None if _is_finite(value) else "a finite number"


def _is_finite(value: Any) -> bool:
    """Whether a value is a finite number."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(value)


@dataclass(frozen=True)
class InsertionTask(TaskDescription):
    """Insertion of a part into a hole with tactile corrections. Lengths in metres, angles in radians."""

    name: str = "insertion"
    sensors: int = 2  # tactile pads; 0 is the left finger
    grid: Grid = _POLICY_GRID  # grid of the flow map on each pad [mm]
    # Frames are selected by depth below the start of an attempt, not by time: the simulation descends faster.
    reference_depth: float = 0.0  # of the reference frame
    frame_depths: tuple[float, ...] = (_DESCENT,)  # of the frames of the observation
    descent: float = _DESCENT  # of the gripper in an attempt, unless the part meets the hole's floor
    start_height: float = 25.5e-3  # height of the part's lower face above the hole's floor at the start of an attempt
    rim_height: float = 25.0e-3  # height of the hole's rim above its floor
    # Necessary for success: the part's lower face is below this height. The simulation also requires the face inside
    # the hole and no stop by contact (`sim/tasks/insertion.py`); the robot requires a descent without contact, then
    # lowers the part into the hole without contact (`real/runner/insertion/insertion_runner.py`).
    success_height: float = 24.7e-3
    attempts: int = 15
    # Correction in x, y, yaw for an action of ±1 of the Gymnasium environments. The output ±1 of a trained network has
    # its own scale, `reach` of its architecture in `policies/networks/`.
    action_scale: tuple[float, float, float] = (20e-3, 20e-3, np.pi / 18)
    workspace: tuple[float, float, float] = (15e-3, 15e-3, np.pi / 12)  # largest |x|, |y|, |yaw| of the gripper
    misalignment: tuple[float, float, float] = (6e-3, 6e-3, np.pi / 18)  # at the start: uniform within ± these
    part: Part = CUBOID
    # Shown to a policy, as an image of the same shape: the flow map, which robots measure too; for comparisons in
    # simulation "forces", the shear forces in parts of 30 mN, or "nothing".
    observation: str = "flow map"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.observation not in OBSERVATIONS:
            raise UsageError(f"observation must be one of {', '.join(OBSERVATIONS)}, got {self.observation!r}")
        self.check_positive("attempts", "descent", "start_height")
        self.check_not_negative("frame_depths", "action_scale", "workspace", "misalignment")
        if not self.frame_depths:
            raise UsageError("frame_depths must have at least one depth")
        if any(start > limit * (1 + 1e-9) for start, limit in zip(self.misalignment, self.workspace, strict=True)):
            raise UsageError(f"misalignment must be within the workspace {self.workspace}, got {self.misalignment}")

    def to_json(self) -> dict[str, Any]:
        """As plain data, without cuboid and flow map, so that it is that of checkpoints of earlier versions."""
        values = super().to_json()
        del values["part"]
        observation = values.pop("observation")
        changed = {} if observation == OBSERVATIONS[0] else {"observation": observation}
        return {**values, **changed, **({} if self.part == CUBOID else {"part": self.part.to_json()})}

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Self:
        """Inverse of `to_json`. Raises UsageError on unknown keys, another task or a newer format."""
        part = data.get("part")
        return super().from_json({**data, "part": Part.from_json(part)} if isinstance(part, dict) else data)

    @property
    def observation_shape(self) -> tuple[int, int, int]:
        """Shape of the flow map's image: (frames * sensors * 2, rows, cols)."""
        return (len(self.frame_depths) * self.sensors * 2, self.grid.rows, self.grid.cols)

    @property
    def corrected_axes(self) -> NDArray[np.float64]:
        """1 for each of x, y, yaw in which the gripper's pose is corrected, else 0; shape (3,)."""
        return (np.asarray(self.workspace) > 0).astype(float)

    def correction(self, action: NDArray[np.float64]) -> NDArray[np.float64]:
        """The correction (dx [m], dy [m], dyaw [rad]) in the gripper's frame for an environment's action in ±1.

        The action is clipped to ±1 and scaled by `action_scale`.
        """
        return np.asarray(np.clip(np.asarray(action, dtype=float), -1, 1) * np.asarray(self.action_scale))

    def corrected(self, pose: NDArray[np.float64], correction: NDArray[np.float64]) -> NDArray[np.float64]:
        """The pose after a correction, limited to the workspace; the same rule for simulation and robot.

        `pose` is (x [m], y [m], yaw [rad]) of the gripper in the hole's frame, shape (…, 3): z up, yaw about it.
        `correction` is (dx, dy, dyaw) in the gripper's frame, whose x points from the left to the right finger and
        whose z is the hole's. Each of x, y, yaw is clipped to its limit of the workspace.
        """
        pose, correction = np.asarray(pose, dtype=float), np.asarray(correction, dtype=float)
        limit = np.asarray(self.workspace)
        return np.asarray(np.clip(compose_planar(pose, correction), -limit, limit))

    def centring_correction(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """The correction (…, 3) in the gripper frame from `pose` (…, 3) to the nearest pose where the part fits."""
        pose = np.asarray(pose, dtype=float)
        yaw = pose[..., 2]
        centring = np.concatenate([rotated(-pose[..., :2], -yaw), -self.part.yaw_error(yaw)[..., None]], axis=-1)
        return np.asarray(centring * self.corrected_axes)

    def reward(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """Reward of gripper poses in the hole's frame, shape (…, 3) [m, m, rad]: −1e4 ‖(x, y)‖² − 20 yaw² (eq. 27).

        yaw is the rotation to the nearest orientation in which the part fits, see `Part.yaw_error`.
        """
        pose = np.asarray(pose, dtype=float)
        return np.asarray(-1e4 * (pose[..., :2] ** 2).sum(-1) - 20 * self.part.yaw_error(pose[..., 2]) ** 2)

    def draw_misalignment(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Random start poses (x [m], y [m], yaw [rad]) in the hole's frame, shape (count, 3)."""
        limit = np.asarray(self.misalignment)
        return rng.uniform(-limit, limit, (count, 3))


INSERTION = InsertionTask()
# With the descents of Xu et al., for comparison.
PUBLISHED_INSERTION = InsertionTask(frame_depths=(1.1e-3,), descent=1.1e-3)


def _default_descent(part: Part) -> float:
    return round(min(_DESCENT, _START_ABOVE_RIM + part.depth / 2), 9)


def insertion_task(
    part: Part,
    *,
    misalignment: tuple[float, float, float] = INSERTION.misalignment,
    descent: float | None = None,
) -> InsertionTask:
    """The insertion of `part` from a misalignment uniform within ± `misalignment` [m, m, rad].

    `descent` [m] is the largest of an attempt, at whose end the flow map is read; None: 4.1 mm, or to half the depth of
    a shallow hole. Heights follow from the depth of the hole. A round part has no yaw at the start, but an action of ±1
    turns the gripper from one limit of the workspace to the other, which shows what the pads did not show before.
    Raises UsageError for a descent at whose end the part is not inserted or touches the floor.
    """
    x, y, yaw = misalignment
    scale_x, scale_y, scale_yaw = INSERTION.action_scale
    descent = _default_descent(part) if descent is None else descent
    lowest, floor = round(_START_ABOVE_RIM + _SUCCESS_BELOW_RIM, 9), round(_START_ABOVE_RIM + part.depth, 9)
    if not lowest < descent < floor:
        raise UsageError(
            f"an attempt must descend by more than {lowest:g} m, the height at which the part counts as inserted, and "
            f"less than {floor:g} m, the floor of the hole; got {descent:g}"
        )
    return dataclasses.replace(
        INSERTION,
        part=part,
        frame_depths=(descent,),
        descent=descent,
        rim_height=part.depth,
        start_height=round(part.depth + _START_ABOVE_RIM, 9),
        success_height=round(part.depth - _SUCCESS_BELOW_RIM, 9),
        misalignment=(x, y, 0.0 if part.is_round else yaw),
        action_scale=(scale_x, scale_y, 2 * INSERTION.workspace[2] if part.is_round else scale_yaw),
    )
