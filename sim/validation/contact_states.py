"""Random states in contact for gradient checks: of each scene, and on each kind of shape.

Newton's method continues to rounding errors after convergence, so that finite differences do not contain solver errors.
"""

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.sim import _core
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.scene.geometry.distance_grid import DistanceGrid, spline_grid
from gelflow.sim.scene.model_spec import core_grid
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.reference_meshes import bracket_distance

Array = NDArray[np.float64]

SHAPES = {  # kind: size [m]
    "plane": (0.0, 0.0, 0.0),
    "sphere": (0.02, 0.0, 0.0),
    "box": (0.03, 0.02, 0.01),
    "cylinder": (0.02, 0.03, 0.0),
    "capsule": (0.015, 0.03, 0.0),
    "ellipsoid": (0.03, 0.02, 0.012),
    "mesh": (1.0, 0.0, 0.0),
}
_TOPS = {
    "plane": 0.0,
    "sphere": 0.02,
    "box": 0.01,
    "cylinder": 0.03,
    "capsule": 0.045,
    "ellipsoid": 0.012,
    "mesh": 0.01,
}
FREE = "free body"  # on a plane
POLISH = 2  # Newton iterations after convergence, as in runs with dual numbers
STEPS = 3  # length of the checked rollouts


def converged_simulator(name: str, law: str, integrator: str) -> Simulator:
    """Simulator of a scene, solved to rounding errors; the rolling pad has 24 × 24 markers."""
    overrides = {"pads.pad.rows": 24, "pads.pad.cols": 24} if name == "rolling" else {}
    scene = load_scene(name, friction=law, overrides={**overrides, "integrator": integrator})
    spec = scene.model_spec()
    spec.polish = POLISH
    sim = Simulator(_core.Model(spec))
    sim.scene = scene
    return sim


def scene_in_contact(name: str, law: str, integrator: str, rng: np.random.Generator) -> tuple[Simulator, Array]:
    """A simulator of a scene in contact, and random controls (steps, nu) for the rollout."""
    sim = converged_simulator(name, law, integrator)
    hold, spread = _PREPARE[name](sim, sim.scene, rng)
    sim.check()
    return sim, hold + rng.normal(size=(STEPS, sim.model.nu)) * spread


def _rolling(sim: Simulator, scene: Scene, rng: np.random.Generator) -> tuple[Array, Array]:
    hold, spread = np.array([0.1, 0.03, 0.2]), np.array([0.05, 0.05, 0.01])
    sim.step([0, 0, 0.2], 120)  # down onto the ball
    sim.step(hold + rng.normal(size=3) * spread, 10)
    return hold, spread


def _insertion(sim: Simulator, scene: Scene, rng: np.random.Generator) -> tuple[Array, Array]:
    """An edge of the part on the rim of the hole."""
    positions = {"arm_x": 0.004, "arm_y": 0.003, "arm_z": 0.0555, "finger_left": -0.0175, "finger_right": -0.0175}
    for joint, value in positions.items():
        sim.q[:, scene.q(joint)] = value
    sim.q[0, scene.q("part")][:3] = [0.004, 0.003, 0.0555]
    hold = np.zeros(scene.nu)
    closing, holding = _both(scene, "finger"), _both(scene, "hold")
    hold[closing], hold[holding] = 5.0, -0.0175
    hold[[scene.u("arm_x"), scene.u("arm_y"), scene.u("arm_z")]] = 0.004, 0.003, 0.0585
    sim.step(hold, 20)
    hold[scene.u("arm_z")] -= 2e-3  # onto the rim
    spread = np.zeros(scene.nu)
    spread[[scene.u(a) for a in ("arm_x", "arm_y", "arm_z")]] = 1e-3
    spread[scene.u("arm_yaw")] = 0.02
    spread[closing] = 0.5
    sim.step(hold + rng.normal(size=scene.nu) * spread, 25)
    return hold, spread


def _pushing(sim: Simulator, scene: Scene, rng: np.random.Generator) -> tuple[Array, Array]:
    """The finger pushes the box away from its centre line."""
    sim.q[:] = scene.q0
    hold = np.zeros(scene.nu)
    hold[scene.u("gripper_x")] = 0.8
    spread = np.array([0.1, 0.1, 0.02, 0.05, 0.05, 0.02])
    sim.step(hold + rng.normal(size=scene.nu) * spread, 40)
    return hold, spread


def _grasp(sim: Simulator, scene: Scene, rng: np.random.Generator) -> tuple[Array, Array]:
    """The bar is grasped away from its centre of mass, still on the tables or lifted."""
    sim.param("bar.com.y")[:] = 0.02
    sim.q[:] = scene.q0
    hold = np.zeros(scene.nu)
    hold[scene.u("arm_z")] = 0.06
    hold[_both(scene, "finger")] = 10.0
    sim.step(hold, 30)
    hold[scene.u("arm_z")] += rng.choice([0.002, 0.008])
    spread = np.array([1e-3, 1e-3, 0.5, 0.5])
    sim.step(hold + rng.normal(size=scene.nu) * spread, 25)
    return hold, spread


def _dclaw(sim: Simulator, scene: Scene, rng: np.random.Generator) -> tuple[Array, Array]:
    """Three fingers rotate the cap."""
    sim.q[:] = scene.q0
    bend, swing = (np.array([a.name.startswith(kind) for a in scene.actuators]) for kind in ("bend", "swing"))
    hold = scene.q0[: scene.nu].copy()
    for _ in range(40):
        hold += bend * (0.1 / 40)
        sim.step(hold)
    hold += swing * 0.08
    spread = np.full(scene.nu, 0.01)
    sim.step(hold + rng.normal(size=scene.nu) * spread, 15)
    return hold, spread


def _both(scene: Scene, what: str) -> list[int]:
    return [scene.u(f"{what}_left"), scene.u(f"{what}_right")]


@cache
def bracket_grid() -> DistanceGrid:
    """Distance grid of a bracket with rounded edges, 40 mm in 20 cells; the inner edge of the elbow is sharp."""
    arm, thick, depth, rounding, spacing = 0.04, 0.016, 0.02, 0.004, 0.002
    low = np.array([0.0, 0.0, -depth / 2]) - 3 * spacing
    lines = [spacing * np.arange(round(length / spacing) + 7) for length in (arm, arm, depth)]
    nodes = low + np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
    inner = [size - 2 * rounding for size in (arm, thick, depth)]
    distances = bracket_distance(nodes.reshape(-1, 3) - [rounding, rounding, 0], *inner) - rounding
    return spline_grid(distances.reshape(nodes.shape[:3]), low - [thick / 2, thick / 2, 0], spacing)


_PREPARE = {"rolling": _rolling, "insertion": _insertion, "pushing": _pushing, "grasp": _grasp, "dclaw": _dclaw}


def cloud_on_shape(kind: str, law: str, integrator: str, rng: np.random.Generator) -> tuple[Simulator, Array]:
    """A cloud of points pressed onto one of SHAPES, or of a FREE body, and random controls for the rollout."""
    return free_cloud(law, integrator, rng) if kind == FREE else pressed_cloud(kind, law, integrator, rng)


def pressed_cloud(kind: str, law: str, integrator: str, rng: np.random.Generator) -> tuple[Simulator, Array]:
    """A cloud of points on a ball joint and slides, pressed onto a shape on a hinge, and random controls (steps, 3)."""
    spec = _core.ModelSpec()
    spec.polish = POLISH
    spec.integrator = integrator
    turret = spec.add_body(_core.BodyDef(name="turret", mass=0.1, inertia=(1e-4, 1e-4, 1e-4, 0, 0, 0)))
    hinge = spec.add_joint(
        _core.JointDef(name="turn", body=turret, type="hinge", axis=(0.3, 0.2, 1), damping=1e-3, frictionloss=1e-4)
    )
    carriage = spec.add_body(_core.BodyDef(name="carriage", mass=0.05, inertia=(1e-5, 1e-5, 1e-5, 0, 0, 0)))
    slides = [
        spec.add_joint(_core.JointDef(name=name, body=carriage, type="slide", axis=axis, damping=0.5))
        for name, axis in (("x", (1, 0, 0)), ("z", (0, 0, 1)))
    ]
    hand = spec.add_body(
        _core.BodyDef(
            name="hand",
            parent=carriage,
            pos=(0, 0, 0.005),
            mass=0.02,
            com=(0, 0, 1e-3),
            inertia=(1e-5, 2e-5, 1e-5, 0, 0, 0),
        )
    )
    spec.add_joint(_core.JointDef(name="ball", body=hand, type="ball", pos=(0, 0, 0.002), damping=1e-3))
    core_kind, grid = ("grid", core_grid(bracket_grid())) if kind == "mesh" else (kind, None)
    shape = spec.add_shape(
        _core.ShapeDef(name="shape", body=turret, kind=core_kind, pos=(1e-3, 0, 0), size=SHAPES[kind], grid=grid)
    )
    add_cloud(spec, hand, {"press": shape}, law, rng)
    spec.add_actuator(_core.ActuatorDef(name="turn", joint=hinge, kind="velocity", kd=2e-3))
    spec.add_actuator(_core.ActuatorDef(name="x", joint=slides[0], kind="general", gain=3.0, bias=2e-3, kp=2.0, kd=0.1))
    spec.add_actuator(
        _core.ActuatorDef(name="z", joint=slides[1], kind="position", kp=300.0, kd=1.0, ctrl_lower=-1.0, ctrl_upper=1.0)
    )
    sim = Simulator(_core.Model(spec))
    height = _TOPS[kind] + 0.012 - 0.005
    sim.q[0, sim.joint_q("z")] = height
    hold, spread = np.array([0.5, 0.0, height - 2e-3]), np.array([0.3, 2e-3, 2e-4])
    sim.step(hold + rng.normal(size=3) * spread, 12)
    sim.check()
    return sim, hold + rng.normal(size=(STEPS, 3)) * spread


def free_cloud(law: str, integrator: str, rng: np.random.Generator) -> tuple[Simulator, Array]:
    """A spinning free body, centre of mass offset, on the ground and at a pusher; and random controls (steps, 1)."""
    spec = _core.ModelSpec()
    spec.polish, spec.integrator, spec.gravity = POLISH, integrator, (0.0, 0.0, -60.0)  # strong enough to keep contact
    body = spec.add_body(
        _core.BodyDef(name="body", mass=0.05, com=(2e-3, -1e-3, 3e-3), inertia=(3e-6, 4e-6, 5e-6, 2e-7, -3e-7, 4e-7))
    )
    spec.add_joint(_core.JointDef(name="free", body=body, type="free"))
    pusher = spec.add_body(
        _core.BodyDef(name="pusher", pos=(-0.03, 0, 0.01), mass=0.02, inertia=(1e-6, 1e-6, 1e-6, 0, 0, 0))
    )
    slide = spec.add_joint(_core.JointDef(name="x", body=pusher, type="slide", axis=(1, 0, 0), damping=0.5))
    ground = spec.add_shape(_core.ShapeDef(name="ground", kind="plane", quat=(0.98, 0.14, 0.14, 0.02)))
    ball = spec.add_shape(_core.ShapeDef(name="ball", body=pusher, kind="sphere", size=(0.02, 0, 0)))
    add_cloud(spec, body, {"on ground": ground, "on pusher": ball}, law, rng)
    spec.add_actuator(_core.ActuatorDef(name="push", joint=slide, kind="motor"))
    sim = Simulator(_core.Model(spec))
    sim.q[0, :3] = 0, 0, 0.011
    sim.v[0, 3:6] = rng.normal(size=3) * 60  # about 0.3 rad per step
    sim.step([0.3], 4)
    sim.check()
    return sim, 0.3 + rng.normal(size=(STEPS, 1)) * 0.1


def add_cloud(spec: Any, body: int, contacts: dict[str, int], law: str, rng: np.random.Generator) -> None:
    """Add points around a body, their contacts with shapes (contact name → shape), and markers just outside of them."""
    cloud = rng.normal(size=(60, 3))
    cloud *= 0.012 / np.linalg.norm(cloud, axis=1)[:, None]
    points = spec.add_points(_core.PointsDef(name="cloud", body=body, points=cloud))
    numbers: dict[str, Any] = {"law": law, "kn": 200.0, "kt": 2.0, "mu": 0.4, "kd": 20.0}
    numbers["ks"] = 100.0 if law == "elastic" else 0.0
    for name, shape in contacts.items():
        spec.add_contact(_core.ContactDef(name=name, points=points, shape=shape, **numbers))
    spec.add_pad(
        _core.PadDef(
            name="skin", body=body, positions=cloud * 1.01, shapes=list(contacts.values()), **{**numbers, "kn": 50.0}
        )
    )
