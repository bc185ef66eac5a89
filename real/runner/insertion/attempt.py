"""Results of attempts and insertions."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.observation import FlowMap
from gelflow.real.runner.touch.observer import TactileReading
from gelflow.real.runner.touch.pad_forces import ForceRecord
from gelflow.session.records import SENSORS

PLAN_COMPLETE = "plan complete"  # outcome of a part on which all motions of a plan were made
PlanarPose = tuple[float, float, float]  # of the gripper relative to the taught hole: x, y [m], yaw [rad]


@dataclass(frozen=True)
class Attempt:
    """One descent and its result."""

    number: int
    planar_pose: PlanarPose  # during the descent
    depth: float  # reached below the start [m]
    shear: float  # mean shear along the finger at the last reading [mm]
    contact: bool  # the shear exceeded the contact threshold
    stopped_by_contact: bool  # the shear exceeded the stop threshold and stopped the descent
    inserted: bool  # lower face below the success height without contact, then lowered into the hole without contact
    duration: float  # [s]
    slipped: bool = False  # the part slipped in the grip
    height_offset: float = 0.0  # of the rim found by touch above the taught one [m]
    observation: FlowMap | None = None  # None when the policy was not evaluated
    correction: NDArray[np.float64] | None = None  # dx, dy [m], dyaw [rad] in the gripper's frame
    reference: TactileReading | None = None
    last: TactileReading | None = None  # the newest reading of the descent
    force: tuple[ForceRecord | None, ...] = ()  # on each pad at the end, where it has a gel and is readable

    @property
    def pad_forces(self) -> dict[str, ForceRecord]:
        """The known forces at the end, by pad: left, right."""
        return {side: force for side, force in zip(SENSORS, self.force, strict=False) if force is not None}

    def summary(self, insertion: int) -> dict[str, Any]:
        """The result as plain data, for the recording."""
        return {
            "insertion": insertion,
            "attempt": self.number,
            "outcome": "inserted" if self.inserted else "not inserted",
            "planar_pose": self.planar_pose,
            "depth": self.depth,
            "shear_mm": self.shear,
            "contact": self.contact,
            "stopped_by_contact": self.stopped_by_contact,
            "slipped": self.slipped,
            "height_offset": self.height_offset,
            "duration": self.duration,
            **({"force": self.pad_forces} if self.pad_forces else {}),
        }


@dataclass(frozen=True)
class Insertion:
    """The attempts on one part, from grasp to release."""

    number: int
    outcome: str  # inserted, not inserted, plan complete, part lost, or the error
    planar_pose: PlanarPose  # of the last attempt
    duration: float  # [s]
    attempts: tuple[Attempt, ...] = field(default=())

    @property
    def inserted(self) -> bool:
        """Whether the part was inserted."""
        return self.outcome == "inserted"

    @property
    def successful(self) -> bool:
        """Whether the part was inserted, or all motions of a plan were made."""
        return self.inserted or self.outcome == PLAN_COMPLETE
