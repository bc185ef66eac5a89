"""A few steps with every part of the core; run by `make sanitize`, and as a quick check after changes of the core.

Other tests check the values: here every call must succeed with finite results.
"""

from typing import Any

import numpy as np
import pytest

from gelflow.errors import UsageError
from gelflow.sim import _core
from gelflow.sim.scene import FRICTION_LAWS, load_scene
from gelflow.sim.scene.geometry.distance_grid import spline_grid
from gelflow.sim.scene.model_spec import core_grid
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation import gradient_check
from gelflow.sim.validation.contact_states import SHAPES, pressed_cloud
from gelflow.sim.validation.reference_motions import SCENES, reference_motion
from gelflow.sim.validation.stress import Precision, StressBatch, StressTest

# Elastic friction and BDF2 use the most code; the viscous law and BDF1 run in single precision.
WAYS: tuple[tuple[str, str, Precision], ...] = (("elastic", "bdf2", "double"), ("viscous", "bdf1", "single"))
FEW: dict[str, dict[str, Any]] = {
    "rolling": {"pads.pad.rows": 8, "pads.pad.cols": 8, "points.pad.resolution": [8, 8, 2], "pads.pad.collides": True},
    "pushing": {"pads.pad.rows": 8, "pads.pad.cols": 8},
    "insertion": {"pads.*.rows": 6, "pads.*.cols": 5},
}


@pytest.mark.parametrize(("law", "integrator", "precision"), WAYS)
@pytest.mark.parametrize("name", SCENES)
def test_scene_with_every_option(name: str, law: str, integrator: str, precision: Precision) -> None:
    overrides = {"integrator": integrator, **FEW.get(name, {})}
    scene = load_scene(name, friction=law, overrides=overrides)
    sim, run = Simulator(scene, num_envs=3, threads=2, precision=precision), reference_motion(scene)
    sim.q[:] = run.q0
    controls = run.step_controls(scene.step)
    for u in controls[:25]:
        sim.step(np.tile(u, (3, 1)))
    sim.check()
    u = np.tile(controls[25], (3, 1))
    for values in (
        sim.tactile(),
        sim.wrenches(),
        sim.poses(),
        sim.mass_matrix(),
        sim.bias(),
        sim.error_estimate(u),
    ):
        assert np.isfinite(values).all()
    trajectory = sim.rollout(np.repeat(u[None], 3, axis=0), read_after=[0, 2])
    assert sim.contact_modes(trajectory).shape == (3, 3)
    gradient = sim.rollout_gradient(trajectory, q=1.0, v=1.0, tactile=1.0, anchors_end=1.0, params=True)
    for values in (gradient.u, gradient.q, gradient.v, gradient.anchors, gradient.history, gradient.params):
        assert np.isfinite(values).all()
    sim.reset([True, False, True])


@pytest.mark.parametrize("law", FRICTION_LAWS)
@pytest.mark.parametrize("kind", SHAPES)
def test_contact_with_every_shape(kind: str, law: str) -> None:
    rng = np.random.default_rng(1)
    sim, u = pressed_cloud(kind, law, "bdf1" if law == "viscous" else "bdf2", rng)
    case = gradient_check.RolloutLoss.random(sim, u, "tactile", rng)
    assert gradient_check.compare_to_dual_numbers(case, rng, directions=1, groups=False).error < 1e-10


def arguments_of(kind: str) -> dict[str, Any]:
    """A rounded solid, or a sphere's distance grid, as arguments of the core."""
    if kind != "grid":
        return {"kind": kind, "size": (0.02, 0.02, 0.02), "rounding": 0.004}
    line = np.linspace(-0.04, 0.04, 17)
    x, y, z = np.meshgrid(line, line, line, indexing="ij")
    grid = spline_grid(np.sqrt(x**2 + y**2 + z**2) - 0.02, np.full(3, line[0]), line[1] - line[0])
    return {"kind": kind, "size": (1, 0, 0), "grid": core_grid(grid)}


@pytest.mark.parametrize("kind", ["grid", "box", "cylinder"])
def test_distance_grid_and_rounded_solid(kind: str) -> None:
    points = np.random.default_rng(2).uniform(-0.03, 0.03, (200, 3))
    spec = _core.ModelSpec()
    body = spec.add_body(_core.BodyDef(name="probe", mass=1.0, inertia=(1, 1, 1, 0, 0, 0)))
    spec.add_joint(_core.JointDef(name="slide", body=body, type="slide", axis=(1, 0, 0)))
    shape = spec.add_shape(_core.ShapeDef(name="shape", **arguments_of(kind)))
    spec.add_pad(
        _core.PadDef(
            name="pad",
            body=body,
            positions=points,
            shapes=[shape],
            kn=1.0,
            kt=0.1,
            mu=0.5,
            kd=0.1,
        )
    )
    model = _core.Model(spec)
    for values in model.distance("shape", points):
        assert np.isfinite(values).all()
    sim = Simulator(model)
    assert sim.tactile().any()
    case = gradient_check.RolloutLoss.random(sim, np.zeros((2, 0)), "tactile", np.random.default_rng(3))
    assert (
        gradient_check.compare_to_dual_numbers(case, np.random.default_rng(4), directions=1, groups=False).error < 1e-10
    )


@pytest.mark.parametrize("precision", ["double", "single"])
def test_stress_batch(precision: Precision) -> None:
    """Continuation in the friction and substeps, forward and backward."""
    halved = 0
    for name in ("rolling", "insertion"):
        sim, u = StressTest(envs=16, steps=8, threads=2, seed=8).start(
            StressBatch(name, "elastic", "bdf2", "all", precision)
        )
        run = sim.rollout(u, read_after=[8])
        assert np.isfinite(run.q).all()
        assert np.isfinite(sim.rollout_gradient(run, q=1.0, v=1.0, tactile=1.0).u).all()
        halved += int((run.halvings > 0).sum())
    assert halved


def test_invalid_input_raises() -> None:
    scene = load_scene("rolling", overrides=FEW["rolling"])
    sim = Simulator(scene)
    with pytest.raises(UsageError, match="is not finite"):
        sim.step([np.nan, 0, 0])
    sim.q[0, 1] = np.inf
    with pytest.raises(UsageError, match="is not finite"):
        sim.step([0, 0, 0.2])
    spec = _core.ModelSpec()
    with pytest.raises(ValueError, match="no joint"):
        _core.Model(spec)
