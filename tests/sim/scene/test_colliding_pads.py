"""Colliding pads: the tactile forces sum to the contact wrench of the pad."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim import _core
from gelflow.sim.benchmark.describe import describe
from gelflow.sim.benchmark.step_times import with_duplicates
from gelflow.sim.scene import FRICTION_LAWS, Scene, load_scene
from gelflow.sim.scene.start_controls import holding_controls
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation import gradient_check
from gelflow.sim.validation.energy import EnergyGauge
from gelflow.sim.validation.reference_motions import reference_motion

COLLIDING: dict[str, dict[str, Any]] = {
    "rolling": {"pads.pad.collides": True, "pads.pad.rows": 20, "pads.pad.cols": 20, "pads.pad.size": [0.04, 0.04]},
    "insertion": {"pads.*.collides": True},
    "dclaw": {"pads.*.collides": True},
}


def with_colliding_pads(name: str, law: str, **more: Any) -> Scene:
    return load_scene(name, friction=law, overrides={**COLLIDING[name], **more})


def in_world(sim: Simulator, scene: Scene, index: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Tactile forces [N] and positions [m] of the markers of a pad in world coordinates, each (markers, 3)."""
    pad = scene.pads[index]
    start = sum(len(p.positions) for p in scene.pads[:index])
    axes, positions = pad.axes, pad.positions
    body = sim.poses()[0, pad.body]
    w, v = body[3], body[4:]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    rotation = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    tactile = sim.tactile()[0, start : start + len(positions)] * [1, 1, -1]
    return np.einsum("mij,mj->mi", axes, tactile) @ rotation.T, positions @ rotation.T + body[:3]


@pytest.mark.parametrize("law", FRICTION_LAWS)
@pytest.mark.parametrize("name", COLLIDING)
def test_tactile_forces_sum_to_the_contact_wrench(name: str, law: str) -> None:
    """After every step of a motion with touching, sticking, slipping and separating markers."""
    scene = with_colliding_pads(name, law)
    sim, run = Simulator(scene), reference_motion(scene)
    sim.q[:] = run.q0
    checked, names = 0, list(sim.model.contact_names)
    for u in run.step_controls(scene.step):
        sim.step(u)
        wrenches = sim.wrenches()[0]
        for i, pad in enumerate(scene.pads):
            forces, positions = in_world(sim, scene, i)
            size = np.linalg.norm(forces, axis=1).sum()
            contact = sum(wrenches[n] for n, c in enumerate(names) if c == pad.name or c.startswith(pad.name + "/"))
            np.testing.assert_allclose(forces.sum(0), contact[3:], atol=1e-12 * size, rtol=0)
            np.testing.assert_allclose(np.cross(positions, forces).sum(0), contact[:3], atol=1e-12 * size, rtol=0)
            checked += bool(size)
    sim.check()
    assert checked > 50


@pytest.mark.parametrize("integrator", ["bdf1", "bdf2"])
@pytest.mark.parametrize("law", FRICTION_LAWS)
def test_gradients(law: str, integrator: str) -> None:
    scene = with_colliding_pads("rolling", law, integrator=integrator)
    spec = scene.model_spec()
    spec.polish = 2
    sim = Simulator(_core.Model(spec))
    sim.step([0, 0, 0.2], 120)
    sim.step([0.1, 0.03, 0.2], 10)
    rng = np.random.default_rng(1)
    outputs: tuple[gradient_check.Output, ...] = ("q", "v", "tactile")
    for output in outputs:
        case = gradient_check.RolloutLoss.random(sim, np.tile([0.12, 0.0, 0.2], (3, 1)), output, rng)
        assert gradient_check.compare_to_dual_numbers(case, rng).error < 1e-10


def test_total_tactile_force_converges_to_the_contact_force() -> None:
    """With stiffness per area, sums over markers and over contact points converge to each other."""
    differences = []
    for fine in (1, 2, 4, 8):
        numbers = {"kn": 1e5, "kt": 1e2, "mu": 0.5, "kd": 1e3}
        pad = {f"pads.pad.{key}": value for key, value in numbers.items()}
        contact = {f"contacts.pad_ball.{key}": value for key, value in numbers.items()}
        size = {"pads.pad.rows": 10 * fine, "pads.pad.cols": 10 * fine, "pads.pad.stiffness": "per area"}
        points = {"points.pad.stiffness": "per area", "points.pad.resolution": [12 * fine + 1, 12 * fine + 1, 2]}
        scene = load_scene("rolling", friction="viscous", overrides={**pad, **contact, **size, **points})
        sim = Simulator(scene)
        sim.step([0, 0, 0.2], 100)
        sim.check()
        normal = sim.tactile()[0, :, 2].sum()
        contact_normal = abs(sim.wrenches()[0, list(sim.model.contact_names).index("pad_ball"), 5])
        differences.append(abs(normal / contact_normal - 1))
    print("difference of the totals:", [f"{d:.1e}" for d in differences])
    assert differences[-1] < 2e-3 and differences[-1] < differences[0] / 8


def test_colliding_pads_share_parameters_and_anchors_with_their_contacts() -> None:
    scene = with_colliding_pads("insertion", "elastic")
    default = load_scene("insertion", friction="elastic")
    assert scene.build().na == default.build().na
    sim = Simulator(scene, num_envs=2)
    sim.q[:] = reference_motion(scene).q0
    sim.param(f"{scene.pads[0].name}.kn")[1] *= 2
    sim.step(np.tile(reference_motion(scene).step_controls(scene.step)[0], (2, 1)))
    assert not np.array_equal(sim.v[0], sim.v[1]), "the parameter of the pad affects the motion"
    gauge = EnergyGauge(scene, num_envs=2)
    assert np.isfinite(gauge.read(sim).total).all()


@pytest.mark.parametrize("law", FRICTION_LAWS)
def test_step_times_are_those_of_the_same_motion(law: str) -> None:
    scene = with_colliding_pads("insertion", law)
    u = holding_controls(scene)
    alone = Simulator(scene, threads=1)
    alone.step(u, 40)
    for name, twice in with_duplicates(scene):
        twice.step(u, 40)
        np.testing.assert_array_equal(twice.q, alone.q, err_msg=name)


def test_describe_and_invalid_values() -> None:
    described = describe(with_colliding_pads("insertion", "viscous"))
    assert all(pad.collides for pad in described.pads)
    assert described.size.contact_pairs > describe(load_scene("insertion")).size.contact_pairs
    assert not any("viscous markers have no history" in line for line in described.not_modelled)
    for scene, passes in ((load_scene("insertion"), True), (with_colliding_pads("insertion", "viscous"), False)):
        without = describe(dataclasses.replace(scene, contacts=()))
        line = next(line for line in without.not_modelled if "no collision" in line)
        assert ("part and finger_left" in line) is passes
    with pytest.raises(UsageError, match="collides must be true or false"):
        load_scene("insertion", overrides={"pads.*.collides": 1})
    with pytest.raises(UsageError, match="unknown key 'pushes'; it is now called 'collides'"):
        load_scene("insertion", overrides={"pads.*.pushes": True})
