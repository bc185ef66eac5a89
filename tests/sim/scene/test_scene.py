"""Public names of gelflow.sim.scene, and scenes built in Python without files."""

from pathlib import Path

import numpy as np
import pytest

from gelflow.errors import UsageError
from gelflow.geometry import Pose
from gelflow.sim import Simulator, scene
from gelflow.sim.scene import WORLD, BodyDef, ContactDef, JointDef, JointLimit, PadDef, PointsDef, Scene, ShapeDef

RADIUS, MASS, KN = 0.02, 0.1, 500.0
PARAMS = {"kn": KN, "kt": 1.0, "mu": 0.5, "kd": 100.0, "ks": 0.0}


def test_every_public_name_resolves() -> None:
    assert set(scene.__all__) <= set(dir(scene))
    assert [name for name in scene.__all__ if not hasattr(scene, name)] == []


def ball_on_ground() -> Scene:
    inertia = 0.4 * MASS * RADIUS**2
    center = Pose(np.array([0.0, 0.0, RADIUS]))
    return Scene(
        name="ball",
        path=Path("ball"),
        step=2e-3,
        bodies=(BodyDef("ball", WORLD, center, MASS, np.zeros(3), np.array([inertia] * 3 + [0.0] * 3)),),
        joints=(JointDef("ball", 0, "free", np.zeros(3), np.array([0.0, 0.0, 1.0]), q_start=0, v_start=0),),
        limits=(JointLimit(),),
        q0=np.array([0.0, 0.0, RADIUS, 1.0, 0.0, 0.0, 0.0]),
        shapes=(ShapeDef("ground", WORLD, "plane", Pose(), np.ones(3)),),
        points=(PointsDef("ball", "ball", 0, np.zeros((1, 3)), np.ones((1, 3)), np.ones(1), radius=RADIUS),),
        contacts=(ContactDef("rest", "rest", "ball", "ground", "viscous", "hunt-crossley", PARAMS),),
        pads=(
            PadDef(
                name="pad",
                body=0,
                shape="points",
                pose=Pose(),
                positions=np.array([[0.0, 0.0, -RADIUS]]),
                axes=np.diag([1.0, -1.0, -1.0])[None],
                weights=np.ones(1),
                grid=None,
                against=("ground",),
                law="viscous",
                params=PARAMS,
            ),
        ),
    )


def test_a_scene_built_in_python_is_simulated() -> None:
    ball = ball_on_ground()
    assert (ball.nq, ball.nv, ball.nu, ball.num_markers) == (7, 6, 0, 1)
    sim = Simulator(ball)
    depth = MASS * 9.81 / KN
    decay = PARAMS["kd"] * depth / (2 * MASS)  # of the oscillation about the rest position [1/s]
    sim.step(np.zeros((1, 0)), round(15 / decay / ball_on_ground().step))
    sim.check()
    assert sim.q[0, 2] == pytest.approx(RADIUS - depth, rel=1e-6)
    np.testing.assert_allclose(sim.tactile()[0], [[0, 0, KN * depth]], rtol=1e-4, atol=1e-9)


def test_marker_grids_need_rectangular_pads() -> None:
    with pytest.raises(UsageError, match="pad 'pad' is not a rectangle and has no marker grid"):
        _ = ball_on_ground().grids
