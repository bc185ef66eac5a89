"""Physical parameters of the insertion: their distributions, and the simulator's parameters that follow from them."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim.tasks.gripper.pads import NOMINAL_PAD_VALUES, PAD_QUANTITIES, pad_parameters
from gelflow.sim.tasks.randomization import Fixed, LogUniform, Quantity, Randomization, Uniform
from gelflow.sim.tasks.sensor_model import NO_SENSOR_EFFECTS, PAIR_QUANTITIES, SENSOR_QUANTITIES
from gelflow.task import InsertionTask

Array = NDArray[np.float64]

ARM_JOINTS = ("arm_x", "arm_y", "arm_z", "arm_yaw")

# The ranges of contact, pad and grasp parameters are published (paper, appendix, Table 7). Quantities that the
# published simulator does not have are chosen here.
_HOLE_QUANTITIES: Mapping[str, Quantity] = {
    "hole_kn": Quantity(LogUniform(2.5e3, 2e4), "N/m", "contact of part and hole, per point"),
    "hole_mu": Quantity(Uniform(0.3, 1.5), "", "friction of part and hole, down to printed plastic"),
}
DEFAULT_RANDOMIZATION = Randomization(
    {
        **{name: row for name, row in PAD_QUANTITIES.items() if row.friction is None},
        **_HOLE_QUANTITIES,
        **{name: row for name, row in PAD_QUANTITIES.items() if row.friction is not None},
        "arm_stiffness": Quantity(LogUniform(200.0, 3e5), "N/m", "servo stiffness of the arm, paper to industrial arm"),
        "grasp_force": Quantity(Uniform(2.5, 16.0), "N", "of each finger"),
        "grasp_height": Quantity(Uniform(-10e-3, 5e-3), "m", "of the pad centres above the part's centre"),
        # The robot stops at a marker displacement; the force at that displacement depends on the gel.
        "stop_shear": Quantity(LogUniform(5e-3, 0.1), "N", "mean shear of the markers at which a descent stops"),
        **NO_SENSOR_EFFECTS,
        # From the published 1e-5 N to the noise of image tracking.
        "noise": SENSOR_QUANTITIES["noise"],
        **PAIR_QUANTITIES,
        "start_height": Quantity(Fixed(0.2e-3), "m", "half-range of the lower face's start height, per attempt"),
    }
)

# As the default, with the deviations of real pads.
FULL_RANDOMIZATION = Randomization({**DEFAULT_RANDOMIZATION.quantities, **SENSOR_QUANTITIES})

# Fixed parameters of the scene file, with the arm stiffness of a robot; for tests and pictures.
NOMINAL = DEFAULT_RANDOMIZATION.replace(
    **NOMINAL_PAD_VALUES,
    hole_kn=5e3,
    hole_mu=1.5,
    arm_stiffness=1e5,
    grasp_force=12.0,
    grasp_height=0.0,
    stop_shear=0.1,
    noise=1e-5,
    start_height=0.0,
)
RANDOMIZATIONS = {"nominal": NOMINAL, "default": DEFAULT_RANDOMIZATION, "full": FULL_RANDOMIZATION}


def insertion_randomization(name: str, task: InsertionTask) -> Randomization:
    """The table `name` of `RANDOMIZATIONS`, with the grasp height of the task's part. Raises UsageError if unknown."""
    if name not in RANDOMIZATIONS:
        raise UsageError(f"randomization must be one of {', '.join(RANDOMIZATIONS)}, got {name!r}")
    table = RANDOMIZATIONS[name]
    low, high = task.part.grasp_height
    return table.replace(grasp_height=float(np.clip(0.0, low, high)) if name == "nominal" else (low, high))


def simulator_parameters(sampled: Mapping[str, Array], *, elastic: bool) -> dict[str, Array]:
    """Parameters of the simulator, name → (n,), for sampled quantities."""
    hole = {"kn": sampled["hole_kn"], "mu": sampled["hole_mu"]}
    if elastic:
        hole["ks"] = hole["kn"] / 2
    params = pad_parameters(sampled, elastic=elastic)
    walls = ("left", "right", "front", "back")
    params |= {f"part_hole/wall_{wall}.{key}": values for wall in walls for key, values in hole.items()}
    # Published ratios to the stiffness: damping 1/200 s, yaw servo 0.05 m².
    for arm, scale in zip(ARM_JOINTS, (1.0, 1.0, 1.0, 0.05), strict=True):
        params[f"{arm}.kp"] = sampled["arm_stiffness"] * scale
        params[f"{arm}.kd"] = sampled["arm_stiffness"] * scale / 200
    return params
