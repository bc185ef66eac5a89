"""Simulation of the scenes: kinematics and mass matrix against MuJoCo, tactile forces, rolling and sliding."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.sim.scene import Scene, load_scene, scene_names
from gelflow.sim.simulator import Simulator


def reference(scene: Scene) -> Any:
    return mujoco.MjModel.from_xml_path(str(scene.path.with_suffix(".xml")))


@pytest.mark.parametrize("name", scene_names())
def test_poses_and_mass_matrix_agree_with_mujoco(name: str) -> None:
    scene = load_scene(name)
    model = reference(scene)
    data = mujoco.MjData(model)
    sim = Simulator(scene)
    rng = np.random.default_rng(5)
    for _ in range(3):
        q = rng.normal(size=scene.nq)
        mujoco.mj_normalizeQuat(model, q)
        data.qpos[:] = sim.q[0] = q
        mujoco.mj_forward(model, data)
        poses = sim.poses()[0]
        for body, pose in zip(scene.bodies, poses, strict=True):
            index = model.body(body.name).id
            np.testing.assert_allclose(pose[:3], data.xpos[index], atol=1e-12)
            matrix = np.zeros(9)
            mujoco.mju_quat2Mat(matrix, pose[3:])
            np.testing.assert_allclose(matrix, data.xmat[index], atol=1e-12)
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        np.testing.assert_allclose(sim.mass_matrix()[0], mass, atol=1e-12)


def test_tactile_forces_agree_with_an_independent_simulator() -> None:
    """States and tactile forces of the pushing scene from DiffRedMax (DiffHand c53b5c4), Newton tolerance 1e-16.

    DiffRedMax evaluates the velocity of the box at the surface point x − d n instead of at the marker x. This changes
    the force of a sticking marker by k_t times the tangential part of ω × (d n), which is corrected here. It changes
    the direction of friction of a slipping marker; these few markers are compared in the normal direction only.
    """
    data = np.load(Path(__file__).parents[2] / "data" / "pushing_reference.npz")
    scene = load_scene("pushing")
    sim = Simulator(scene, num_envs=len(data["step"]))
    sim.q[:], sim.v[:] = data["q"], data["v"]
    got, poses, pad = sim.tactile().copy(), sim.poses(), scene.pads[0]
    stuck_markers = 0
    for env, expected in enumerate(data["tactile"]):
        finger, box = (rotation(pose[3:]) for pose in poses[env])
        markers = poses[env, 0, :3] + pad.positions @ finger.T
        depth, normal = box_distance((markers - poses[env, 1, :3]) @ box, 0.025)
        normal = normal @ box.T
        turning = np.cross([0, 0, sim.v[env, 6]], depth[:, None] * normal)
        turning -= (turning * normal).sum(1)[:, None] * normal
        shift = pad.params["kt"] * np.where(depth < 0, 1, 0)[:, None] * turning @ finger @ pad.axes[0]
        shift[:, 2] *= -1
        force = (expected * [1, 1, -1]) @ (finger @ pad.axes[0]).T
        pressure = np.abs((force * normal).sum(1))
        stuck = np.sqrt(np.maximum((force**2).sum(1) - pressure**2, 0)) < 0.999 * pad.params["mu"] * pressure
        stuck_markers += stuck.sum()
        np.testing.assert_allclose((got[env] - shift)[stuck], expected[stuck], rtol=0, atol=1e-13)
        np.testing.assert_allclose((got[env] - shift)[:, 2], expected[:, 2], rtol=0, atol=2e-8)
        assert (got[env][depth >= 0] == 0).all()
    assert stuck_markers > 0.95 * (data["tactile"][..., 2] > 0).sum()


def rotation(quat: NDArray[np.float64]) -> NDArray[np.float64]:
    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, quat)
    return flat.reshape(3, 3)


def box_distance(points: NDArray[np.float64], half: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Signed distance and outward normal of points inside a cube, or in front of one of its faces."""
    beyond = np.abs(points) - half
    face, row = beyond.argmax(1), np.arange(len(points))
    normal = np.zeros_like(points)
    normal[row, face] = np.sign(points[row, face])
    return beyond.max(1), normal


ROLLING = [((0.0, 0.0, 0.2), 100), ((0.1, 0, 0.2), 50), ((-0.2, 0, 0.2), 50), ((0, 0.1, 0.2), 50)]


@pytest.mark.parametrize("friction", ["viscous", "elastic"])
def test_ball_rolls_between_pad_and_ground(friction: str) -> None:
    """Without slip the ball moves half as far as the pad and rotates by distance over radius."""
    scene = load_scene("rolling", friction=friction, overrides={"pads.pad.rows": 25, "pads.pad.cols": 25})
    sim = Simulator(scene)
    for force, steps in ROLLING[:1]:
        sim.step(np.array(force), steps)
    start = sim.q[0].copy()
    reading = sim.tactile()[0]
    assert (reading[:, 2] > 0).sum() > 20
    # Under normal load only, the normal forces have point symmetry.
    normal = reading[:, 2].reshape(25, 25)
    np.testing.assert_allclose(normal, normal[::-1, ::-1], atol=1e-6)
    for force, steps in ROLLING[1:]:
        sim.step(np.array(force), steps)
        sim.check()
        pad, ball = (sim.q[0] - start)[:2], (sim.q[0] - start)[3:5]
        np.testing.assert_allclose(ball, pad / 2, atol=0.04 * np.abs(pad).max())
    assert np.linalg.norm(pad) > 0.02
    turn = 2 * np.arccos(min(1.0, abs(sim.q[0, 6])))
    assert turn == pytest.approx(np.linalg.norm(ball) / 0.02, rel=0.05)


@pytest.mark.parametrize("friction", ["viscous", "elastic"])
def test_tactile_shear_has_the_direction_of_the_load(friction: str) -> None:
    """A ball dragged along +x pulls the pad along −x; y of the pad is −y of the world."""
    scene = load_scene("rolling", friction=friction, overrides={"pads.pad.rows": 25, "pads.pad.cols": 25})
    for force, axis, sign in (((0.1, 0, 0.2), 0, -1), ((0, 0.1, 0.2), 1, 1)):
        sim = Simulator(scene)
        sim.step(np.array([0.0, 0, 0.2]), 100)
        before = sim.tactile()[0].sum(0)
        sim.step(np.array(force, dtype=float), 4)
        change = sim.tactile()[0].sum(0) - before
        assert sign * change[axis] > 0
        assert abs(change[axis]) > 10 * abs(change[1 - axis])


def test_box_under_the_elastic_law_does_not_creep() -> None:
    """A box on the ground stays in place under a force below the friction limit."""
    scene = load_scene("pushing", friction="elastic")
    sim = Simulator(scene)
    u = np.zeros(scene.nu)
    u[scene.u("box_y")] = 0.2  # friction holds up to 0.8 × 0.735 N
    sim.step(u, 100)
    before = sim.q[0, scene.q("box_y")].copy()
    sim.step(u, 200)
    assert abs(sim.q[0, scene.q("box_y")] - before)[0] < 1e-7
