"""Gradients exactly at kinks: finite, repeatable, and those of the mode that the step takes.

Numbers are powers of two, so that a state is exactly at the border of two contact modes. A body stays there because of
its joint or the balance of its forces. The state is read at the start and after each step.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.sim import _core
from gelflow.sim.scene import FRICTION_LAWS, INTEGRATORS
from gelflow.sim.simulator import Simulator
from gelflow.sim.trajectory import Trajectory, TrajectoryGradient
from gelflow.sim.validation.gradient_check import RolloutLoss, compare_to_dual_numbers

Array = NDArray[np.float64]

UNIT = 2.0**-10  # [m]; a depth, a slip, a speed
LAW = {"kn": 1024.0, "kt": 512.0, "mu": 0.5, "kd": 0.0}  # UNIT deep: 1 N; friction up to 0.5 N, at UNIT per second
SIZE = {"sphere": (1, 0, 0), "box": (1, 0.5, 0.5), "cylinder": (0.5, 1, 0), "capsule": (0.5, 1, 0)}
SIZES = {kind: tuple(16 * UNIT * s for s in size) for kind, size in SIZE.items()} | {"plane": (0, 0, 0)}
SIZES |= {"ellipsoid": (32 * UNIT, 16 * UNIT, 16 * UNIT)}

Kink = Callable[[str], Simulator]  # of an integrator


def probe(
    integrator: str,
    *,
    kind: str = "plane",
    at: tuple[float, float, float] = (0, 0, 0),
    law: str = "viscous",
    numbers: dict[str, float] = LAW,
    slides: str = "y",
    joint: dict[str, Any] | None = None,
    actuator: dict[str, Any] | None = None,
) -> Simulator:
    """A contact point with a marker at a position of a shape, without gravity, on slides."""
    spec = _core.ModelSpec()
    spec.gravity = (0, 0, 0)
    spec.tolerance = 1e-13
    spec.step = 2.0**-8
    spec.integrator = integrator
    body = spec.add_body(_core.BodyDef(name="probe", mass=0.25, inertia=(1e-3, 1e-3, 1e-3, 0, 0, 0)))
    for axis in slides:
        last = spec.add_joint(
            _core.JointDef(name=axis, body=body, type="slide", axis=np.eye(3)["xyz".index(axis)], **joint or {})
        )
    shape = spec.add_shape(_core.ShapeDef(name="shape", kind=kind, size=SIZES[kind]))
    all_numbers: dict[str, Any] = {**numbers, "law": law, "ks": 512.0 if law == "elastic" else 0.0}
    spec.add_contact(
        _core.ContactDef(
            name="touch",
            points=spec.add_points(_core.PointsDef(name="point", body=body, points=[at], areas=[(0.25, 0.25, 0.5)])),
            shape=shape,
            **all_numbers,
        )
    )
    spec.add_pad(_core.PadDef(name="pad", body=body, positions=np.array([at]), shapes=[shape], **all_numbers))
    spec.add_actuator(_core.ActuatorDef(name="drive", joint=last, **{"kind": "motor"} | (actuator or {})))
    return Simulator(_core.Model(spec))


def anchored(sim: Simulator, at: tuple[float, float, float]) -> Simulator:
    sim.anchors[:], sim.anchored[:] = at, 1
    return sim


def moving(sim: Simulator, v: float) -> Simulator:
    sim.v[:] = v
    return sim


# Positions without a gradient of the distance [UNIT]. The point moves along y only, without force in y.
PLACES: dict[str, dict[str, tuple[float, float, float]]] = {
    "sphere": {"centre": (0, 0, 0)},
    "box": {
        "centre": (0, 0, 0),
        "medial plane": (8, 0, 0),
        "two faces equally near": (12, 0, 4),
        "an edge": (16, 0, 8),
        "a face": (16, 0, 0),
    },
    "cylinder": {"axis": (0, 0, 4), "centre": (0, 0, 0), "wall and end equally near": (4, 0, 12)},
    "capsule": {"segment": (0, 0, 4), "end of the segment": (0, 0, 16), "beside its end": (1, 0, 16)},
    "ellipsoid": {"centre": (0, 0, 0), "long axis": (2, 0, 0), "middle plane": (0, 0, 4)},
}


def place(kind: str, where: str, law: str) -> Kink:
    x, y, z = PLACES[kind][where]
    return lambda integrator: probe(integrator, kind=kind, at=(x * UNIT, y * UNIT, z * UNIT), law=law)


KINKS: dict[str, Kink] = {
    **{
        f"{kind}, {where}, {law}": place(kind, where, law)
        for kind, many in PLACES.items()
        for where in many
        for law in FRICTION_LAWS
    },
    "just touching, at rest": lambda i: probe(i, slides="xyz"),
    "just touching, elastic": lambda i: probe(i, slides="xyz", law="elastic"),
    "just touching, anchored": lambda i: anchored(probe(i, slides="xyz", law="elastic"), (0, 0, 0)),
    "no slip speed": lambda i: probe(i, at=(0, 0, -UNIT), slides="xy"),
    "no slip speed, no friction": lambda i: probe(i, at=(0, 0, -UNIT), slides="xy", numbers=LAW | {"mu": 0.0}),
    "stick and slip, viscous": lambda i: moving(probe(i, at=(0, 0, -UNIT)), UNIT),
    "stick and slip, elastic": lambda i: anchored(probe(i, at=(0, 0, -UNIT), law="elastic"), (0, -UNIT, -UNIT)),
    "no normal force left": lambda i: moving(probe(i, at=(0, 0, -UNIT), slides="z", numbers=LAW | {"kd": 1024.0}), 1.0),
    "actuator at its force": lambda i: probe(i, actuator={"force_upper": 0.5, "force_lower": -0.5}),
    "actuator at its control": lambda i: probe(i, actuator={"ctrl_upper": 0.5, "ctrl_lower": -0.5}),
    "servo at its force": lambda i: probe(
        i, joint={"stiffness": 1.0, "springref": -0.5}, actuator={"kind": "position", "kp": 1.0, "force_upper": 0.5}
    ),
    "limit reached": lambda i: probe(i, joint={"upper": 0.0, "limit_stiffness": 64.0, "limit_damping": 1.0}),
    "both limits far": lambda i: probe(i, joint={"lower": -1.0, "upper": 1.0, "limit_stiffness": 64.0}),
    "dry friction, at rest": lambda i: probe(i, joint={"frictionloss": 0.5}),
    "dry friction, creeping": lambda i: moving(probe(i, joint={"frictionloss": 0.5}), 1e-3),
    "no dry friction": lambda i: moving(probe(i), 1e-3),
}
DRIVEN = ("actuator at its force", "actuator at its control", "servo at its force", "dry friction, creeping")


def gradient_of(sim: Simulator, name: str) -> tuple[Trajectory, TrajectoryGradient]:
    """Gradient of a scalar of all outputs with respect to all inputs."""
    u = np.full((2, sim.num_envs, 1), 0.5 if name in DRIVEN else 0.0)
    run = sim.rollout(u, read_after=(0, 1, 2))
    assert not run.status.any()
    rng = np.random.default_rng(0)
    weights = [rng.normal(size=x[:, :1].shape) for x in (run.q, run.v, run.tactile)]
    ends = [rng.normal(size=x[-1, :1].shape) for x in (run.anchors, run.history)]
    q, v, tactile = weights
    return run, sim.rollout_gradient(
        run, q=q, v=v, tactile=tactile, anchors_end=ends[0], history_end=ends[1], params=True
    )


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("name", KINKS)
def test_gradients_at_kinks_are_finite_and_repeatable(name: str, integrator: str) -> None:
    _, first = gradient_of(KINKS[name](integrator), name)
    _, again = gradient_of(KINKS[name](integrator), name)
    one = KINKS[name](integrator)
    many = Simulator(one.model, num_envs=5, threads=2)
    for part in ("q", "v", "params", "anchors", "anchored", "history"):
        getattr(many, part)[:] = getattr(one, part)
    _, batched = gradient_of(many, name)
    for part in ("u", "q", "v", "anchors", "history", "params"):
        value, axis = getattr(first, part), 1 if part == "u" else 0
        assert np.isfinite(value).all(), part
        assert value.tobytes() == getattr(again, part).tobytes()
        for env in range(5):
            assert value.tobytes() == np.take(getattr(batched, part), [env], axis=axis).tobytes()
    assert first.params.any()


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("name", KINKS)
def test_gradients_are_those_of_the_mode_of_the_step(name: str, integrator: str) -> None:
    """Dual numbers branch by values only, and take the same mode."""
    sim, rng = KINKS[name](integrator), np.random.default_rng(1)
    u = np.full((2, 1), 0.5 if name in DRIVEN else 0.0)
    for output in ("q", "v", "tactile"):
        case = RolloutLoss.random(sim, u, output, rng)
        for steps in (u, u[:1]):
            assert compare_to_dual_numbers(replace(case, u=steps), rng, directions=2).error < 1e-10


def test_states_are_exactly_at_a_kink() -> None:
    """At the start and after the steps, small displacements to either side give other contact modes."""
    for name, change, moves in (
        ("stick and slip, viscous", "v", 1),
        ("stick and slip, elastic", "anchors", 1),
        ("actuator at its force", "u", 0),
        ("servo at its force", "u", 0),
        ("limit reached", "q", 0),
    ):
        signatures: list[int] = []
        for shift in (-1e-9, 0.0, 1e-9):
            sim = KINKS[name]("bdf1")
            u = np.full((1, 1, 1), 0.5 if name in DRIVEN else 0.0)
            if change == "u":
                u += shift
            else:
                getattr(sim, change)[..., 1 if change == "anchors" else 0] += shift
            if moves:  # evaluated at the state: a step would leave it
                reading = sim.tactile()[0, 0]
                signatures.append(int(np.hypot(*reading[:2]) < LAW["mu"] * abs(reading[2])))
            else:
                signatures.append(int(sim.contact_modes(sim.rollout(u))[0, 0]))
        assert len(set(signatures)) == 2, (name, signatures)
    for name in (
        "sphere, centre, viscous",
        "cylinder, axis, elastic",
        "just touching, at rest",
        "dry friction, creeping",
    ):
        sim = KINKS[name]("bdf1")
        start = sim.q.copy()
        u = np.full((3, 1, 1), 0.5 if name in DRIVEN else 0.0)
        run = sim.rollout(u)
        if name in DRIVEN:
            np.testing.assert_array_equal(run.v[-1], run.v[0])
        else:
            np.testing.assert_array_equal(run.q[-1], start)
