"""Parameters that a calibration fits, and their prior distributions from the randomization table."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.policies.calibration.model.shear_model import QUANTITIES
from gelflow.policies.calibration.recordings import Recordings
from gelflow.sim.tasks.insertion_randomization import insertion_randomization
from gelflow.sim.tasks.randomization import LogUniform, Uniform
from gelflow.sim.tasks.sensor_model import PAIR_QUANTITIES

Array = NDArray[np.float64]

WIDENING = 3.0  # positive quantities are expected from a third of the table's lower limit to three times its upper one
_SENSOR = (  # name, unit, meaning, logarithmic, centre, standard deviation
    ("gain_left", "", "gain of the left pad relative to the scene's gel, including its lag", True, 1.0, 0.5),
    ("gain_right", "", "gain of the right pad relative to the scene's gel, including its lag", True, 1.0, 0.5),
    ("turn_left", "rad", "rotation of the left camera about its pad's normal", False, 0.0, 0.1),
    ("turn_right", "rad", "rotation of the right camera about its pad's normal", False, 0.0, 0.1),
    ("crosstalk", "", "part of a printed marker's motion that is the mean of its neighbours", False, 0.15, 0.26),
)
_GEL_GAIN = 1.5  # standard deviation of the logarithm of a pad's gain [mm/N], whose gel is not that of the scene
COMMANDED_FORCE = 0.1  # relative standard deviation of the grasp force around the commanded one
FARTHEST = 4.0  # largest whitened parameter or start height of a fit
TAUGHT_HEIGHT = 2e-3  # standard deviation of the grasp height around that of the lab file [m]


@dataclass(frozen=True)
class Parameter:
    """One parameter; its prior is normal in its logarithm if `log` is set, else in itself."""

    name: str
    unit: str
    meaning: str
    log: bool
    center: float  # median of the prior
    width: float  # standard deviation of the prior, of the logarithm if `log` is set

    def value(self, whitened: Array) -> Array:
        """Values from standard normal coordinates."""
        shifted = self.width * np.asarray(whitened)
        return np.asarray(self.center * np.exp(shifted) if self.log else self.center + shifted)

    def whitened(self, value: Array) -> Array:
        """Inverse of `value`."""
        value = np.asarray(value, dtype=float)
        return np.asarray((np.log(value / self.center) if self.log else value - self.center) / self.width)

    def slope(self, whitened: float) -> float:
        """Derivative of `value`."""
        return float(self.value(np.array(whitened))) * self.width if self.log else self.width


def parameters(recordings: Recordings) -> tuple[Parameter, ...]:
    """Parameters of the simulator (`QUANTITIES`), then those of the sensors, for these recordings."""
    table = insertion_randomization("default", recordings.task)
    fitted = []
    for name in QUANTITIES:
        row = table[name]
        given = row.distribution
        assert isinstance(given, Uniform | LogUniform)
        log = name != "grasp_height"
        if log:
            low, high = math.log(given.low / WIDENING), math.log(given.high * WIDENING)
            center, width = math.exp((low + high) / 2), (high - low) / math.sqrt(12)
        else:
            center, width = (given.low + given.high) / 2, WIDENING * (given.high - given.low) / math.sqrt(12)
        if name == "grasp_force" and recordings.grasp_force is not None:
            center, width = recordings.grasp_force, COMMANDED_FORCE
        if name == "grasp_height" and recordings.grasp_height is not None:
            center, width = recordings.grasp_height, TAUGHT_HEIGHT
        fitted.append(Parameter(name, row.unit, row.meaning, log, center, width))
    for name, unit, meaning, log, center, width in _SENSOR:
        wide = _GEL_GAIN if recordings.unit == "mm" and name.startswith("gain") else width
        fitted.append(Parameter(name, unit, meaning, log, center, wide))
    return tuple(fitted)


def gain_ratio(fitted: Sequence[Parameter]) -> tuple[Parameter, Array]:
    """Gain of the right pad relative to the left one, and its direction in the whitened parameters (count,)."""
    by_name = {p.name: (i, p) for i, p in enumerate(fitted)}
    (i, left), (k, right) = by_name["gain_left"], by_name["gain_right"]
    width = math.hypot(left.width, right.width)
    direction = np.zeros(len(fitted))
    direction[i], direction[k] = -left.width / width, right.width / width
    row = PAIR_QUANTITIES["gain_ratio"]
    return Parameter("gain_ratio", row.unit, row.meaning, True, right.center / left.center, width), direction
