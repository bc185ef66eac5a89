"""Free bodies thrown on planes, and the change of their energy in each step."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gelflow.sim import _core
from gelflow.sim.scene.geometry.sampling import box_surface, cylinder
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.energy import EnergyGauge

Array = NDArray[np.float64]
Kind = Literal["sphere", "box", "cylinder"]
KINDS: tuple[Kind, ...] = get_args(Kind)

GRAVITY = 9.8  # [m/s²]
MASS = 0.3  # [kg]
SIZE = 0.02  # [m]
_BOX = SIZE * np.array([1.0, 1.5, 0.6])
_HALF_LENGTH = 1.2 * SIZE


def _body(kind: Kind) -> tuple[Array, Array, float]:
    """Contact points, principal moments of inertia per mass [m²], and radius of a sphere's contact point or 0."""
    if kind == "sphere":
        return np.zeros((1, 3)), np.full(3, 0.4 * SIZE**2), SIZE
    if kind == "box":
        square = _BOX**2 / 3
        return box_surface(_BOX.tolist(), (3, 3, 3))[0], square.sum() - square, 0.0
    across = SIZE**2 / 4 + _HALF_LENGTH**2 / 3
    points = cylinder(SIZE, _HALF_LENGTH, angles=24, radii=2, heights=3, faces=("-z", "wall", "+z"))[0]
    return points, np.array([across, across, SIZE**2 / 2]), 0.0


@dataclass(frozen=True)
class ThrownBody:
    """A free body above a ground plane and a plane inclined by 45°."""

    kind: Kind
    law: str  # of friction
    damping: str
    step: float  # [s]
    numbers: Mapping[str, float]  # kn, kt, mu, kd, ks per point
    integrator: str = "bdf1"
    has_rotation: bool = True  # False: three slides instead of a free joint
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of mass, in the body's frame [m]
    tolerance: float = 1e-9  # of Newton's method

    @property
    def reach(self) -> float:
        """Largest distance of a point from the body's origin [m]."""
        points, _, radius = _body(self.kind)
        return float(np.linalg.norm(points, axis=1).max()) + radius

    def model_spec(self) -> _core.ModelSpec:
        """The definitions of the body and the planes."""
        spec = _core.ModelSpec()
        points, moments, radius = _body(self.kind)
        spec.gravity, spec.step, spec.tolerance = (0.0, 0.0, -GRAVITY), self.step, self.tolerance
        spec.integrator = self.integrator
        body = spec.add_body(
            _core.BodyDef(name="body", mass=MASS, com=self.center, inertia=(*(MASS * moments), 0.0, 0.0, 0.0))
        )
        if self.has_rotation:
            spec.add_joint(_core.JointDef(name="free", body=body, type="free"))
        else:
            for name, axis in zip("xyz", np.eye(3), strict=True):
                spec.add_joint(_core.JointDef(name=name, body=body, type="slide", axis=axis))
        sampled = spec.add_points(_core.PointsDef(name="points", body=body, points=points, radius=radius))
        lean = (np.cos(np.pi / 8), 0.0, -np.sin(np.pi / 8), 0.0)  # normal (−1, 0, 1) / √2
        planes = {"ground": ((0, 0, 0), (1, 0, 0, 0)), "slope": ((3 * SIZE, 0, 0), lean)}
        for name, (pos, quat) in planes.items():
            plane = spec.add_shape(_core.ShapeDef(name=name, kind="plane", pos=pos, quat=quat, size=(1.0, 1.0, 1.0)))
            spec.add_contact(
                _core.ContactDef(
                    name=f"on {name}", points=sampled, shape=plane, law=self.law, damping=self.damping, **self.numbers
                )
            )
        return spec


@dataclass(frozen=True)
class EnergyChange:
    """Energy changes of all steps, (steps, N) [J]."""

    change: Array  # energy after the step minus energy before it
    scale: Array  # energy scale before the step: kinetic, stored, and weight times reach
    halved: NDArray[np.bool_]  # steps that were split into substeps
    total: Array  # (steps + 1, N): energy


def throw_bodies(body: ThrownBody, rng: np.random.Generator, *, bodies: int, steps: int) -> EnergyChange:
    """Throws bodies from random positions and at random speeds, up to some 5 m/s and 100 rad/s. Some start at rest."""
    sim = Simulator(_core.Model(body.model_spec()), num_envs=bodies, threads=1)
    gauge = EnergyGauge(body, num_envs=bodies)
    speed = np.exp(rng.uniform(np.log(0.01), np.log(2.0), (bodies, 1))) * (rng.random((bodies, 1)) < 0.9)
    sim.v[:, :3] = speed * rng.normal(size=(bodies, 3))
    if body.has_rotation:
        turn = rng.normal(size=(bodies, 4))
        turn[: bodies // 3] = 1, 0, 0, 0
        sim.q[:, 3:] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
        sim.v[:, 3:] = speed / SIZE * rng.normal(size=(bodies, 3)) * (rng.random((bodies, 1)) < 0.8)
    sim.q[:, 2] = body.reach
    for _ in range(3):  # to the surface of the planes
        sim.q[:, 2] += gauge.points(sim)[0].max(1)
    sim.q[:, 2] += rng.choice([-1e-4, 0.0, 0.3 * body.reach], bodies)
    rows: list[tuple[NDArray[Any], ...]] = []
    before = gauge.read(sim)
    total = [before.total]
    for _ in range(steps):
        halvings = sim.halved.copy()
        sim.step(np.zeros(0))
        after = gauge.read(sim)
        scale = before.kinetic + before.contact + before.friction + MASS * GRAVITY * body.reach
        rows.append((after.total - before.total, scale, sim.halved > halvings))
        total.append(after.total)
        before = after
    sim.check()
    change, scale, halved = (np.array(column) for column in zip(*rows, strict=True))
    return EnergyChange(change, scale, halved, np.array(total))
