"""A mechanism with every kind of coupling, in contact, for checks of gradients, energy and momentum.

A crank drives a rocker through a rod (a four-bar linkage, closed by a connect). A lift follows the crank linearly and a
dial follows the lift; a cam follows the crank by a polynomial. A tendon with spring, limit, dry friction and armature
joins crank, rocker and cam and is driven by an actuator. A free plate is welded to the lift and presses on the ground.
"""

import numpy as np
from numpy.typing import NDArray

from gelflow.sim import _core
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.contact_states import POLISH, add_cloud

Array = NDArray[np.float64]

STEPS = 8
LIFT, DIAL = (0.0115, -0.02), (0.1, 5.0)  # offset and ratio: of the lift to the crank, of the dial to the lift
CAM = (0.02, 0.5, 0.8, -0.3)  # polynomial of the crank
CRANK_TIP, ROD_TIP = np.array([0.05, 0.0, 0.08]), np.array([0.15, 0.0, 0.02])  # in the frames of crank and rod [m]
ROCKER = np.array([0.2, 0.0, 0.0])  # pivot of the rocker [m]
_INERTIA = (2e-4, 2e-4, 1e-4, 1e-5, 0, 0)


def coupled_mechanism(law: str, integrator: str, rng: np.random.Generator) -> tuple[Simulator, Array]:
    """The mechanism in motion on the ground, and random controls (steps, 2)."""
    sim = Simulator(_core.Model(mechanism_spec(law, integrator, rng)))
    hold, spread = np.array([0.05, 0.02]), np.array([0.1, 0.05])
    sim.step(hold + rng.normal(size=2) * spread, 15)
    sim.check()
    return sim, hold + rng.normal(size=(STEPS, 2)) * spread


def mechanism_spec(law: str, integrator: str, rng: np.random.Generator) -> _core.ModelSpec:
    """The definitions of the mechanism."""
    spec = _core.ModelSpec()
    spec.polish, spec.integrator = POLISH, integrator
    joint = {
        name: _add_link(spec, name, parent, pos, kind)
        for name, parent, pos, kind in (
            ("crank", -1, (0, 0, 0), "hinge"),
            ("rod", 0, CRANK_TIP, "hinge"),
            ("rocker", -1, ROCKER, "hinge"),
            ("lift", -1, (0.5, 0, 0), "slide"),
            ("dial", -1, (0, 0.5, 0), "hinge"),
            ("cam", -1, (0, 1, 0), "hinge"),
        )
    }
    plate = spec.add_body(
        _core.BodyDef(name="plate", pos=(0.5, 0, LIFT[0]), mass=0.05, inertia=(3e-6, 4e-6, 5e-6, 0, 0, 0))
    )
    spec.add_joint(_core.JointDef(name="plate", body=plate, type="free"))
    ground = spec.add_shape(_core.ShapeDef(name="ground", kind="plane", pos=(0.5, 0, 0), quat=(0.98, 0.14, 0.14, 0.02)))
    add_cloud(spec, plate, {"on ground": ground}, law, rng)
    spec.add_coupling(_core.CouplingDef(name="dial", joint=joint["dial"], leader=joint["lift"], coefficients=DIAL))
    spec.add_coupling(_core.CouplingDef(name="lift", joint=joint["lift"], leader=joint["crank"], coefficients=LIFT))
    spec.add_coupling(
        _core.CouplingDef(
            name="cam law", joint=joint["cam"], leader=joint["crank"], coefficients=CAM, stiffness=20.0, damping=0.02
        )
    )
    spec.add_loop_closure(
        _core.LoopClosureDef(
            name="pin", first=1, second=2, first_pos=ROD_TIP, second_pos=CRANK_TIP + ROD_TIP - ROCKER,
            stiffness=2e4, damping=20.0,
        )
    )  # fmt: skip
    spec.add_loop_closure(
        _core.LoopClosureDef(
            name="glue", first=plate, second=3, first_pos=(0, 0, 1e-3), second_pos=(0, 0, 1e-3), weld=True,
            stiffness=2e3, damping=2.0, turn_stiffness=2.0, turn_damping=2e-3,
        )
    )  # fmt: skip
    tendon = spec.add_tendon(
        _core.TendonDef(
            name="belt", joints=[joint["crank"], joint["rocker"], joint["cam"]], coefficients=[0.5, -0.3, 0.2],
            stiffness=0.5, springref=0.01, damping=5e-3, armature=1e-4, frictionloss=2e-3,
            lower=-1.0, upper=0.0, limit_stiffness=1.0, limit_damping=1e-3,
        )
    )  # fmt: skip
    spec.add_actuator(_core.ActuatorDef(name="pull", tendon=tendon, kind="position", gear=2.0, kp=0.5, kd=0.01))
    spec.add_actuator(_core.ActuatorDef(name="spin", joint=joint["dial"], kind="motor", gear=0.1))
    return spec


def _add_link(spec: _core.ModelSpec, name: str, parent: int, pos: object, kind: str) -> int:
    body = spec.add_body(
        _core.BodyDef(
            name=name, parent=parent, pos=np.asarray(pos, float), mass=0.1, com=(0.02, 0, 0.03), inertia=_INERTIA
        )
    )
    axis = (0, 1, 0) if kind == "hinge" else (0, 0, 1)
    return spec.add_joint(_core.JointDef(name=name, body=body, type=kind, axis=axis, damping=2e-3))
