"""Closed forms of contact: a sphere on a pad with stiffness per area, and a part in a grasp for ten seconds."""

import numpy as np
import pytest

from gelflow.sim import _core
from gelflow.sim.simulator import Simulator
from gelflow.sim.tasks.insertion import InsertionAttempts, insertion_scene
from gelflow.sim.tasks.insertion_randomization import NOMINAL

RADIUS, DEPTH, STIFFNESS = 0.020, 1e-3, 1e8  # [m], [m], [N/m³]


def pressed(side: int) -> float:
    """Sum of the normal forces of side × side markers on 16 × 16 mm, pressed by DEPTH onto a fixed sphere [N]."""
    spec = _core.ModelSpec()
    body = spec.add_body(
        _core.BodyDef(name="pad", pos=(0, 0, RADIUS - DEPTH), mass=0.1, inertia=(1e-5, 1e-5, 1e-5, 0, 0, 0))
    )
    spec.add_joint(_core.JointDef(name="height", body=body, type="slide"))
    sphere = spec.add_shape(_core.ShapeDef(name="sphere", kind="sphere", size=(RADIUS, 0, 0)))
    pitch = 0.016 / side
    line = (np.arange(side) - (side - 1) / 2) * pitch
    x, y = np.meshgrid(line, line)
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(side * side)])
    axes = [np.tile(axis, (len(points), 1)) for axis in ((1.0, 0, 0), (0, -1.0, 0), (0, 0, -1.0))]
    areas = np.full(len(points), pitch**2)
    spec.add_pad(
        _core.PadDef(
            name="pad",
            body=body,
            positions=points,
            axes=np.stack(axes, axis=-1),
            shapes=[sphere],
            weights=areas,
            kn=STIFFNESS,
            kt=0.0,
            mu=0.0,
            kd=0.0,
        )
    )
    return float(Simulator(_core.Model(spec)).tactile()[0, :, 2].sum())


def test_force_of_a_sphere_on_a_pad_with_stiffness_per_area() -> None:
    """The sum over markers converges to F = π K (R − δ) δ²."""
    exact = np.pi * STIFFNESS * (RADIUS - DEPTH) * DEPTH**2
    errors = [abs(pressed(side) / exact - 1) for side in (25, 50, 100, 200, 400)]
    print([f"{error:.1e}" for error in errors])
    assert errors[3] < 1e-3
    assert errors[4] < errors[1] < errors[0]


@pytest.mark.parametrize("integrator", ["bdf1", "bdf2"])
def test_grasped_part_does_not_creep_and_markers_show_its_load_under_the_elastic_law(integrator: str) -> None:
    attempts = InsertionAttempts(1, scene=insertion_scene(friction="elastic"), randomization=NOMINAL)
    attempts.draw(np.random.default_rng(0))
    spec = attempts.scene.model_spec()
    spec.integrator = integrator
    sim, u = Simulator(_core.Model(spec)), attempts._u
    for name in ("q", "params", "anchors", "anchored"):
        getattr(sim, name)[:] = getattr(attempts.sim, name)
    sim.step(u, 200)  # 1 s
    height = attempts.scene.q("part").start + 2
    before = sim.q[0, height]
    sim.step(u, 2000)  # 10 s
    sim.check()
    assert abs(sim.q[0, height] - before) < 1e-6
    weight = float(sim.param("part.mass")[0]) * 9.8
    contacts = list(sim.model.contact_names)
    carried = sum(-sim.wrenches()[0, contacts.index(f"pad_{side}"), 5] for side in ("left", "right"))
    assert carried == pytest.approx(weight, rel=1e-6)
    shear = sim.tactile()[0, :, 0]  # towards the fingertip, downwards
    assert (shear > 0).all() and shear.std() < 1e-3 * shear.mean()
