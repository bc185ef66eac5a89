"""The expert that an insertion policy imitates: it knows the true pose of the part."""

import numpy as np
from numpy.typing import NDArray

from gelflow.task import InsertionTask

Array = NDArray[np.float64]

_MIN_TOLERANCE = 1.5e-3  # [m]
_TURN_SHARE = 0.8  # yaw to which the gripper turns a round part, as a fraction of the yaw of the workspace


def expert_correction(task: InsertionTask, pose: Array, signs: Array) -> Array:
    """The corrections (n, 3) [m, m, rad] that the network learns for poses (n, 3), mirrored by `signs` (n, 3).

    They centre the part. A round part, whose yaw does not matter, is also turned from one side to the other. The pads
    show a misalignment along their faces well, but one across them poorly: it changes their normal forces, which no
    marker shows, more than their shear. Two attempts at different yaw show both directions.
    """
    correction = task.centring_correction(pose) * signs
    if task.part.is_round:
        yaw, side = pose[:, 2] * signs[:, 2], _TURN_SHARE * task.workspace[2]
        correction[:, 2] = np.where(yaw > 0, -side, side) - yaw
    return correction


def part_tolerance(task: InsertionTask) -> tuple[float, float, float]:
    """The gap beside the part in x and y, at least 1.5 mm [m], and the yaw that moves a corner by the smaller [rad].

    The lower limit is needed in a narrow hole, where the first attempts of a part show the direction of its
    misalignment but hardly its length. There, a loss that is bounded at the gap is flat over most possible lengths.
    """
    x, y = (max(clearance / 2, _MIN_TOLERANCE) for clearance in task.part.clearance)
    corner = float(np.hypot(*task.part.size[:2])) / 2
    return x, y, min(x, y) / corner
