"""From what the physics of a simulated insertion is drawn, part by part.

The ranges of contact, pads and grasp are the published ones (Table 7 of the paper's appendix). Where that table has no
entry because its simulator lacks the quantity, the choice is ours and says why.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError

Array = NDArray[np.float64]
Range = tuple[float, float]

# Relaxation times of the elastic law, k_v / k_s: long enough to damp, short enough that a frame taken during the
# fast simulated descent shows what a slow robot's shows.
CONTACT_RELAXATION = 10e-3  # [s]
MARKER_RELAXATION = 5e-3  # [s]


@dataclass(frozen=True)
class SampledPhysics:
    """The physics of N parts."""

    params: dict[str, Array]  # simulator parameter → values, shape (N,)
    grasp_force: Array  # of each finger [N]
    grasp_height: Array  # of the pads' centres above the part's [m]
    stop_shear: Array  # mean shear along the finger at which touch stops a descent [N per marker]
    noise: Array  # standard deviation of a marker's force [N]


@dataclass(frozen=True)
class Randomization:
    """Ranges (low, high), per part; those marked log are drawn uniformly in the logarithm."""

    grasp_force: Range = (2.5, 16.0)  # of each finger [N]
    grasp_height: Range = (-10e-3, 5e-3)  # of the pads' centres above the part's [m]
    start_height: float = 0.2e-3  # of the part's lower face, ± at each attempt [m]
    pad_kn: Range = (2e3, 1.4e4)  # pad against part, per point [N/m]
    pad_mu: Range = (0.5, 2.5)
    pad_kt: Range = (20.0, 140.0)  # viscous law [N s/m]
    pad_ks: Range = (100.0, 1000.0)  # elastic law, log [N/m]: a soft to a stiff gel
    marker_kn: Range = (50.0, 450.0)  # [N/m]
    marker_mu: Range = (0.5, 2.5)
    marker_kd: Range = (0.0, 100.0)  # [N s/m²]
    marker_kt: Range = (0.2, 2.3)  # viscous law [N s/m]
    marker_ks: Range = (50.0, 450.0)  # elastic law, log [N/m]
    hole_kn: Range = (2.5e3, 2e4)  # part against hole, log [N/m]: how hard both are
    hole_mu: Range = (0.3, 1.5)  # printed plastic is smoother than the 1.5 of the published scene
    # A servo of 200 N/m is the published arm; a robot yields hundreds of times less. Log [N/m].
    arm_stiffness: Range = (200.0, 3e5)
    # A robot stops at a displacement of the markers; how many newtons that is depends on the gel. Log [N].
    stop_shear: Range = (5e-3, 0.1)
    noise: Range = (1e-5, 1e-3)  # of a marker's force, log [N]: from the published 1e-5 to a tracked image's

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, tuple) and not 0 <= value[1] - value[0] < np.inf:
                raise UsageError(f"randomization: {name} must be (low, high) with low ≤ high, got {value}")

    def sample(self, rng: np.random.Generator, count: int, *, elastic: bool) -> SampledPhysics:
        """The physics of `count` parts, under the elastic or the viscous law."""

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
        # Damping and the yaw servo keep the published proportions to the stiffness: 1/200 s, 0.05 m².
        for arm, scale in (("arm_x", 1.0), ("arm_y", 1.0), ("arm_z", 1.0), ("arm_yaw", 0.05)):
            params[f"{arm}.kp"] = stiffness * scale
            params[f"{arm}.kd"] = stiffness * scale / 200
        return SampledPhysics(
            params, uniform(self.grasp_force), uniform(self.grasp_height), log(self.stop_shear), log(self.noise)
        )


DEFAULT_RANDOMIZATION = Randomization()

# One fixed physics, as in the scene file, with an arm as stiff as a robot's: for tests and pictures.
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
