"""Scenes in the simulator: its kinematics and masses against MuJoCo's, and what the scenes do."""

from typing import Any

import mujoco
import numpy as np
import pytest

from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.simulator import Simulator


def reference(scene: Scene) -> Any:
    return mujoco.MjModel.from_xml_path(str(scene.path.with_suffix(".xml")))


@pytest.mark.parametrize("name", ["insertion", "pushing", "rolling"])
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
