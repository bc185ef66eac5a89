"""Contact and markers of the two pads of the parallel gripper, as quantities of a randomization table."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from gelflow.sim.tasks.randomization import Fixed, LogUniform, Quantity, Uniform

PADS = ("left", "right")

# Relaxation times k_t / k_s of the elastic law: long enough to damp vibration, short enough that a frame of a fast
# simulated motion equals one of the slow motion of a robot.
CONTACT_RELAXATION = 10e-3  # [s]
MARKER_RELAXATION = 5e-3  # [s]

# Published ranges (paper, appendix, Table 7), and for the elastic law the range of soft to stiff gels.
PAD_QUANTITIES: Mapping[str, Quantity] = {
    "pad_kn": Quantity(Uniform(2e3, 1.4e4), "N/m", "normal stiffness of a pad, per point"),
    "pad_mu": Quantity(Uniform(0.5, 2.5), "", "friction of a pad"),
    "marker_kn": Quantity(Uniform(50.0, 450.0), "N/m", "normal stiffness of a marker"),
    "marker_mu": Quantity(Uniform(0.5, 2.5), "", "friction of a marker"),
    "marker_kd": Quantity(Uniform(0.0, 100.0), "N s/m²", "normal damping of a marker"),
    "pad_ks": Quantity(LogUniform(100.0, 1000.0), "N/m", "shear stiffness of a pad, per point", "elastic"),
    "marker_ks": Quantity(LogUniform(50.0, 450.0), "N/m", "shear stiffness of a marker", "elastic"),
    "pad_kt": Quantity(Uniform(20.0, 140.0), "N s/m", "shear damping of a pad, per point", "viscous"),
    "marker_kt": Quantity(Uniform(0.2, 2.3), "N s/m", "shear damping of a marker", "viscous"),
}
# Values of the scene files.
NOMINAL_PAD_VALUES: Mapping[str, float] = {
    "pad_kn": 8e3,
    "pad_mu": 1.5,
    "marker_kn": 250.0,
    "marker_mu": 1.5,
    "marker_kd": 25.0,
    "pad_ks": 250.0,
    "marker_ks": 150.0,
    "pad_kt": 80.0,
    "marker_kt": 1.25,
}
NOMINAL_PADS: Mapping[str, Quantity] = {
    name: Quantity(Fixed(NOMINAL_PAD_VALUES[name]), row.unit, row.meaning, row.friction)
    for name, row in PAD_QUANTITIES.items()
}


def pad_parameters(sampled: Mapping[str, NDArray[np.float64]], *, elastic: bool) -> dict[str, NDArray[np.float64]]:
    """Parameters of the simulator, name → (n,), for sampled `PAD_QUANTITIES`."""
    pad = {"kn": sampled["pad_kn"], "mu": sampled["pad_mu"]}
    marker = {"kn": sampled["marker_kn"], "mu": sampled["marker_mu"], "kd": sampled["marker_kd"]}
    if elastic:
        pad["ks"], marker["ks"] = sampled["pad_ks"], sampled["marker_ks"]
        pad["kt"], marker["kt"] = CONTACT_RELAXATION * pad["ks"], MARKER_RELAXATION * marker["ks"]
    else:
        pad["kt"], marker["kt"] = sampled["pad_kt"], sampled["marker_kt"]
    params = {f"pad_{side}.{key}": values for side in PADS for key, values in pad.items()}
    return params | {f"{side}.{key}": values for side in PADS for key, values in marker.items()}
