"""World poses of sites: equal to MuJoCo's, for environments with individual parameters, with gradients."""

import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from gelflow.errors import UsageError
from gelflow.geometry import Pose
from gelflow.sim import _core, torch_layer
from gelflow.sim.scene import Scene, load_scene, scene_names
from gelflow.sim.scene.mjcf.mechanics import WORLD, SiteDef
from gelflow.sim.scene.mjcf.model_file import compile_model
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation import gradient_check

ENVS = 3


def with_sites(name: str) -> Scene:
    """A scene whose every body, and the world, has a site with a general pose."""
    scene, rng = load_scene(name), np.random.default_rng(0)
    sites = []
    for body in range(WORLD, len(scene.bodies)):
        quat = rng.normal(size=4)
        sites.append(SiteDef(f"site{body}", body, Pose(rng.normal(size=3) * 0.1, quat / np.linalg.norm(quat))))
    return replace(scene, sites=(*scene.sites, *sites))


def moved(scene: Scene, *, precision: str = "double") -> Simulator:
    sim = Simulator(scene, num_envs=ENVS, precision=precision)  # type: ignore[arg-type]
    tangents = 0.3 * np.random.default_rng(1).normal(size=(ENVS, scene.nv))
    sim.q[:] = gradient_check.retract(sim.model, scene.q0, tangents)
    sim.param(f"{scene.bodies[0].name}.pos.x")[:] += 0.01 * np.arange(ENVS)
    return sim


@pytest.mark.parametrize("name", scene_names())
def test_poses_equal_those_of_mujoco(name: str) -> None:
    scene = load_scene(name)
    model = compile_model(scene.path.parent / f"{name}.xml").model
    assert len(scene.sites) == model.nsite
    sim = moved(scene)
    sim.params[:] = sim.model.param_defaults
    poses, data = sim.site_poses(), mujoco.MjData(model)
    for env in range(ENVS):
        data.qpos[:] = sim.q[env]
        mujoco.mj_kinematics(model, data)
        for i, site in enumerate(scene.sites):
            index = model.site(site.name).id
            np.testing.assert_allclose(poses[env, i, :3], data.site_xpos[index], atol=1e-12)
            rotation = Pose(poses[env, i, :3], poses[env, i, 3:]).matrix()
            np.testing.assert_allclose(rotation.ravel(), data.site_xmat[index], atol=1e-12)


def test_poses_follow_bodies_and_parameters() -> None:
    scene = with_sites("dclaw")
    sim = moved(scene)
    poses, bodies = sim.site_poses(), sim.poses()
    for env in range(ENVS):
        for i, site in enumerate(scene.sites):
            body = Pose() if site.body == WORLD else Pose(bodies[env, site.body, :3], bodies[env, site.body, 3:])
            expected = body @ site.pose
            np.testing.assert_allclose(poses[env, i, :3], expected.position, atol=1e-14)
            same = abs(float(poses[env, i, 3:] @ expected.quaternion))
            assert same == pytest.approx(1, abs=1e-14)
    along = np.stack([sim.q, sim.q + 0, scene.q0 + 0 * sim.q])
    many = sim.site_poses(along)
    assert many.shape == (3, ENVS, len(scene.sites), 7)
    np.testing.assert_array_equal(many[1], poses)
    single = moved(scene, precision="single").site_poses()
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, poses, atol=1e-6)


@pytest.mark.parametrize("name", scene_names())
def test_gradients_agree_with_central_differences(name: str) -> None:
    """Positions and quaternions of all sites, along random tangents of q; slides, hinges and free joints."""
    scene = with_sites(name)
    sim, rng = moved(scene), np.random.default_rng(2)
    q = torch.tensor(sim.q.copy(), requires_grad=True)
    poses = torch_layer.torch_site_poses(sim, q)
    weights = rng.normal(size=tuple(poses.shape))
    (by_q,) = torch.autograd.grad((poses * torch.from_numpy(weights)).sum(), q)
    for _ in range(4):
        direction = rng.normal(size=(ENVS, scene.nv))
        ours = sum(
            float(gradient_check.to_tangent(sim.model, sim.q[env], by_q[env].numpy()) @ direction[env])
            for env in range(ENVS)
        )
        ends = []
        for size in (-1e-5, 1e-5):
            moved_q = np.stack([gradient_check.retract(sim.model, sim.q[e], size * direction[e]) for e in range(ENVS)])
            ends.append(float((sim.site_poses(moved_q) * weights).sum()))
        assert (ends[1] - ends[0]) / 2e-5 == pytest.approx(ours, rel=1e-7, abs=1e-7)


def test_gradient_through_a_rollout() -> None:
    """The gradient of a site's height by the controls is that of the positions, carried on by the reverse pass."""
    scene = with_sites("insertion")
    sim = Simulator(scene)
    site = scene.site(f"site{scene.body('part')}")
    u = torch.zeros((3, 1, scene.nu), dtype=torch.float64, requires_grad=True)
    run = torch_layer.torch_rollout(sim, torch_layer.torch_state(sim), u)
    (ours,) = torch.autograd.grad(torch_layer.torch_site_poses(sim, run.q)[-1, 0, site, 2], u)
    positions = run.q.detach().requires_grad_()
    (by_q,) = torch.autograd.grad(torch_layer.torch_site_poses(sim, positions)[-1, 0, site, 2], positions)
    recorded = sim.rollout(u.detach().numpy())
    expected = sim.rollout_gradient(recorded, q=by_q.numpy()).u
    assert expected.any()
    np.testing.assert_array_equal(ours, expected)


def test_wrong_shapes_and_scenes_without_sites_raise() -> None:
    scene = with_sites("pushing")
    sim = Simulator(scene, num_envs=2)
    with pytest.raises(UsageError, match=re.escape(f"q must have shape (…, 2, {scene.nq}), got (3, {scene.nq})")):
        sim.site_poses(np.zeros((3, scene.nq)))
    with pytest.raises(UsageError, match="no site 'tip'"):
        scene.site("tip")
    with pytest.raises(UsageError, match="the scene has no sites"):
        Simulator(sim.model).site_poses()
    wrong = _core.SiteDef(name="tip", body=99, pos=np.zeros(3), quat=[1, 0, 0, 0])
    with pytest.raises(ValueError, match="site 'tip' refers to body 99"):
        _core.site_poses(sim.model, [wrong], sim.params, sim.q)


def test_wrong_states_and_parameters_are_refused() -> None:
    sim = Simulator(with_sites("rolling"), num_envs=2)
    q, first = sim.q.copy(), sim.joint_q("ball") + 3
    q[1, 0] = np.nan
    with pytest.raises(UsageError, match=re.escape("q[1, 0] is not finite")):
        sim.site_poses(q)
    q[1] = q[0]
    q[1, first : first + 4] = 0
    with pytest.raises(UsageError, match=r"the quaternion of joint 'ball'.* has length 0"):
        torch_layer.torch_site_poses(sim, torch.from_numpy(q))
    sim.param("ball.mass")[1] = np.nan
    with pytest.raises(UsageError, match=r"environment 1: parameter 'ball\.mass' must be a number"):
        sim.site_poses()
