"""The state of a robot, its sensors and its policy at one time, as pages show it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.geometry import Pose
from gelflow.perception.tracker import TrackingResult
from gelflow.session.records import Decision


@dataclass(frozen=True)
class PadImage:
    """The newest image of one camera."""

    pixels: NDArray[np.uint8]  # B G R, shape (height, width, 3)
    stamp: float  # of the exposure, robot time [s]
    tracked: TrackingResult | None = None  # None: no markers are known in this image
    problem: str = ""  # the reason why there are none


@dataclass(frozen=True)
class Snapshot:
    """The measurements known at `time`; None where nothing was measured yet."""

    time: float  # robot time [s]
    pads: tuple[PadImage | None, ...] = (None, None)
    joints: tuple[float, ...] | None = None  # [rad]
    flange: Pose | None = None  # in the base frame
    gripper: Mapping[str, Any] | None = None  # width [m], force [N], grasp, …
    phase: str = ""  # of the run
    insertion: int | None = None
    attempt: int | None = None  # of this insertion
    decision: Decision | None = None  # the last one before
    checks: Sequence[Mapping[str, Any]] = ()  # of the run: name, ok, text
    forces: tuple[Mapping[str, Any] | None, ...] = (None, None)  # on each pad, as in `gelflow.Force`

    @property
    def part_held(self) -> bool:
        """Whether the gripper holds a part."""
        return self.gripper is not None and self.gripper.get("grasp") == "holding"
