"""Domain randomization of the insertion task: distributions of the physical parameters of a part.

The ranges of contact, pad and grasp parameters are published (paper, appendix, Table 7). Quantities that the published
simulator does not have are chosen here, with the reason beside them.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError

Array = NDArray[np.float64]
Range = tuple[float, float]

# Relaxation times k_t / k_s of the elastic law: long enough to damp vibration, short enough that a frame of the fast
# simulated descent equals one of the slow descent of the robot.
CONTACT_RELAXATION = 10e-3  # [s]
MARKER_RELAXATION = 5e-3  # [s]


@dataclass(frozen=True)
class SampledPhysics:
    """Physical parameters of N parts."""

    params: dict[str, Array]  # name of the simulator parameter → values, shape (N,)
    grasp_force: Array  # of each finger [N]
    grasp_height: Array  # of the pad centres above the part's centre [m]
    stop_shear: Array  # mean shear along the finger at which contact stops a descent [N per marker]
    noise: Array  # standard deviation of a marker's force [N]


@dataclass(frozen=True)
class Randomization:
    """Ranges (low, high), sampled per part; those marked "log" are uniform in the logarithm."""

    grasp_force: Range = (2.5, 16.0)  # of each finger [N]
    grasp_height: Range = (-10e-3, 5e-3)  # of the pad centres above the part's centre [m]
    start_height: float = 0.2e-3  # half-range of the lower face's start height, per attempt [m]
    pad_kn: Range = (2e3, 1.4e4)  # contact of pad and part, per point [N/m]
    pad_mu: Range = (0.5, 2.5)
    pad_kt: Range = (20.0, 140.0)  # viscous law [N s/m]
    pad_ks: Range = (100.0, 1000.0)  # elastic law, log [N/m]: soft to stiff gels
    marker_kn: Range = (50.0, 450.0)  # [N/m]
    marker_mu: Range = (0.5, 2.5)
    marker_kd: Range = (0.0, 100.0)  # [N s/m²]
    marker_kt: Range = (0.2, 2.3)  # viscous law [N s/m]
    marker_ks: Range = (50.0, 450.0)  # elastic law, log [N/m]
    hole_kn: Range = (2.5e3, 2e4)  # contact of part and hole, log [N/m]
    hole_mu: Range = (0.3, 1.5)  # includes printed plastic, below the published 1.5
    # From the published servo of 200 N/m to the stiffness of an industrial arm; log [N/m].
    arm_stiffness: Range = (200.0, 3e5)
    # The robot stops at a marker displacement; the force at that displacement depends on the gel. Log [N].
    stop_shear: Range = (5e-3, 0.1)
    noise: Range = (1e-5, 1e-3)  # of a marker force, log [N]: from the published 1e-5 to the noise of image tracking

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, tuple) and not 0 <= value[1] - value[0] < np.inf:
                raise UsageError(f"randomization: {name} must be (low, high) with low ≤ high, got {value}")

    def sample(self, rng: np.random.Generator, count: int, *, elastic: bool) -> SampledPhysics:
        """Sample the physics of `count` parts, for the elastic or the viscous friction law."""

        def uniform(limits: Range) -> Array:
            return rng.uniform(limits[0], limits[1], count)

        def log(limits: Range) -> Array:
            return np.exp(rng.uniform(np.log(limits[0]), np.log(limits[1]), count))

        pad = {"kn": uniform(self.pad_kn), "mu": uniform(self.pad_mu)}
        marker = {"kn": uniform(self.marker_kn), "mu": uniform(self.marker_mu), "kd": uniform(self.marker_kd)}
        hole = {"kn": log(self.hole_kn), "mu": uniform(self.hole_mu)}
        if elastic:
            pad["ks"], marker["ks"], hole["ks"] = log(self.pad_ks), log(self.marker_ks), hole["kn"] / 2
            pad["kt"], marker["kt"] = CONTACT_RELAXATION * pad["ks"], MARKER_RELAXATION * marker["ks"]
        else:
            pad["kt"], marker["kt"] = uniform(self.pad_kt), uniform(self.marker_kt)
        stiffness = log(self.arm_stiffness)
        params = {f"pad_{side}.{key}": values for side in ("left", "right") for key, values in pad.items()}
        params |= {f"{side}.{key}": values for side in ("left", "right") for key, values in marker.items()}
        walls = ("left", "right", "front", "back")
        params |= {f"part_hole/wall_{wall}.{key}": values for wall in walls for key, values in hole.items()}
        # Published ratios to the stiffness: damping 1/200 s, yaw servo 0.05 m².
        for arm, scale in (("arm_x", 1.0), ("arm_y", 1.0), ("arm_z", 1.0), ("arm_yaw", 0.05)):
            params[f"{arm}.kp"] = stiffness * scale
            params[f"{arm}.kd"] = stiffness * scale / 200
        return SampledPhysics(
            params, uniform(self.grasp_force), uniform(self.grasp_height), log(self.stop_shear), log(self.noise)
        )


DEFAULT_RANDOMIZATION = Randomization()

# Fixed parameters of the scene file, with the arm stiffness of a robot; for tests and pictures.
NOMINAL = Randomization(
    grasp_force=(12.0, 12.0),
    grasp_height=(0.0, 0.0),
    start_height=0.0,
    pad_kn=(8e3, 8e3),
    pad_mu=(1.5, 1.5),
    pad_kt=(80.0, 80.0),
    pad_ks=(250.0, 250.0),
    marker_kn=(250.0, 250.0),
    marker_mu=(1.5, 1.5),
    marker_kd=(25.0, 25.0),
    marker_kt=(1.25, 1.25),
    marker_ks=(150.0, 150.0),
    hole_kn=(5e3, 5e3),
    hole_mu=(1.5, 1.5),
    arm_stiffness=(1e5, 1e5),
    stop_shear=(0.1, 0.1),
    noise=(1e-5, 1e-5),
)
