"""The grasp scene: geometry, and a bar that is lifted and weighed by the tactile forces."""

import numpy as np
import pytest

from gelflow.cli.main import main
from gelflow.sim.scene import FRICTION_LAWS, load_scene
from gelflow.sim.simulator import Simulator

GRAVITY = 9.8


def closed(sim: Simulator, force: float = 10.0) -> np.ndarray:
    """Close the fingers on the bar; returns the controls that hold it."""
    scene = load_scene("grasp")
    sim.q[:] = scene.q0
    u = np.zeros(scene.nu)
    u[scene.u("arm_z")] = 0.06
    u[[scene.u("finger_left"), scene.u("finger_right")]] = force
    sim.step(u, 30)
    return u


def lift(sim: Simulator, u: np.ndarray, steps: int) -> None:
    for k in range(steps):
        sim.step(u + np.array([0, 0.03 * min(1.0, (k + 1) / 40), 0, 0]))
    sim.check()


def test_bar_matches_the_publication() -> None:
    scene = load_scene("grasp")
    bar = scene.bodies[scene.body("bar")]
    assert bar.mass == pytest.approx(11 * 500 * 0.025**3)
    np.testing.assert_allclose(bar.com, 0, atol=1e-15)
    across = (0.025**2 + 0.275**2) / 12 * bar.mass
    np.testing.assert_allclose(bar.inertia[:3], [across, 0.025**2 / 6 * bar.mass, across])
    assert (scene.nq, scene.nv, scene.nu) == (11, 10, 4)
    assert [g.rows * g.cols for g in scene.grids] == [130, 130]
    tables = [s for s in scene.shapes if s.name.startswith("table")]
    np.testing.assert_allclose([s.size for s in tables], [[0.025, 0.015, 0.02]] * 2)
    np.testing.assert_allclose([s.pose.position[1] for s in tables], [-0.1, 0.1])


@pytest.mark.parametrize("law", FRICTION_LAWS)
def test_bar_at_rest_stays_on_the_tables(law: str) -> None:
    scene = load_scene("grasp", friction=law)
    sim = Simulator(scene)
    sim.step(np.array([0, 0.06, 0, 0]), 200)
    sim.check()
    np.testing.assert_allclose(sim.q[0, scene.q("bar")], scene.q0[scene.q("bar")], atol=1e-4)


@pytest.mark.parametrize("law", FRICTION_LAWS)
def test_gripper_lifts_the_bar(law: str) -> None:
    sim = Simulator(load_scene("grasp", friction=law))
    lift(sim, closed(sim), 70)
    bar = sim.q[0, sim.joint_q("bar") :]
    assert bar[2] - 0.0525 > 0.02
    assert 2 * np.arccos(min(1.0, bar[3])) < 1e-3  # no tilt: it is held at its middle
    resting = [i for i, name in enumerate(sim.model.contact_names) if name.startswith("bar_rest/")]
    assert not sim.wrenches()[0, resting].any()


@pytest.mark.parametrize("mass", [0.051, 0.085, 0.12])
def test_tactile_forces_give_the_weight(mass: float) -> None:
    """Contact points and markers have the same shear displacement: the ratio of forces is that of total stiffnesses."""
    scene = load_scene("grasp", friction="elastic")
    sim = Simulator(scene)
    sim.param("bar.mass")[:] = mass
    lift(sim, closed(sim), 100)
    forces = sim.tactile()[0]
    # The pads are mirrored: y has the opposite sign.
    np.testing.assert_allclose(forces[:130], forces[130:] * [1, -1, 1], atol=1e-9)
    below_top = sim.poses()[0, scene.body("bar"), 2] + 0.0125 - sim.q[0, sim.joint_q("arm_z")]
    points = scene.points[0].points  # only one of the two faces of a pad is in contact
    point_stiffness = 2 * ((points[:, 2] < below_top) & (points[:, 0] > -1e-9)).sum() * scene.contacts[0].params["ks"]
    marker_stiffness = (forces[:, 2] > 0).sum() * scene.pads[0].params["ks"]
    assert forces[:, 0].sum() * point_stiffness / marker_stiffness == pytest.approx(mass * GRAVITY, rel=0.02)
    assert abs(forces[:, 1].sum()) < 1e-6


def test_bar_held_off_its_centre_of_mass_tilts() -> None:
    sim = Simulator(load_scene("grasp", friction="elastic"), num_envs=2)
    sim.param("bar.com.y")[:] = 0.05, -0.05
    lift(sim, closed(sim), 100)
    tilt = 2 * sim.q[:, sim.joint_q("bar") + 4]  # about x; positive: the +y end rises
    assert tilt[0] == pytest.approx(-tilt[1], rel=1e-6)
    assert -0.2 < tilt[0] < -0.005


def test_describe_shows_the_scene(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["describe", "grasp", "--no-timing"]) == 0
    text = capsys.readouterr().out
    assert "grasp: steps of 5 ms, elastic law" in text
    assert "bar: 0.08594 kg" in text
    assert "left: 13 × 10 markers" in text
