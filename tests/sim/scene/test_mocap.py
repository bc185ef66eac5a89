"""Mocap bodies: bodies that are moved from outside."""

from pathlib import Path

import numpy as np
import pytest

from gelflow.errors import UsageError
from gelflow.sim.benchmark.describe import describe
from gelflow.sim.scene import FRICTION_LAWS, INTEGRATORS, Scene, load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation import gradient_check

MODEL = """<mujoco>
  <worldbody>
    <body name="before" pos="0 0 2"><joint name="before" type="slide"/><geom size="0.1"/></body>
    <body name="paddle" mocap="true" pos="0 0 -0.05">
      <geom name="paddle" type="box" size="0.1 0.1 0.05"/>
      <body name="flap" pos="0.3 0 0">
        <joint name="flap" axis="0 1 0" damping="0.01"/><geom size="0.02" pos="0.1 0 0"/>
      </body>
    </body>
    <body name="part" pos="0.01 0.02 0.05">
      <freejoint name="part"/><geom name="part" type="box" size="0.03 0.03 0.05"/>
    </body>
    <body name="carried" pos="0 0.5 0"><freejoint name="carried"/><geom size="0.05" mass="0.2"/></body>
  </worldbody>
  <equality><weld body1="paddle" body2="carried"/></equality>
  <keyframe>
    <key name="home" qpos="0.3 0 0.01 0.02 0.05 1 0 0 0 0 0.5 0 1 0 0 0" mpos="0 0 -0.05" mquat="1 0 0 0"/>
  </keyframe>
</mujoco>"""
SCENE = """
format = 1
model = "mocap.xml"
step = 1e-3
tolerance = 1e-12
[points.part]
geom = "part"
resolution = [3, 3, 2]
[contacts.part]
points = "part"
against = "paddle"
kn = 1e4
kt = 20
mu = 0.6
kd = 30
elastic = { ks = 2000 }
"""
TWIST = [0.05, -0.02, 0.1, 0.2, 0.1, -0.3]


def mocap_scene(folder: Path, **options: str) -> Scene:
    (folder / "mocap.xml").write_text(MODEL)
    (folder / "mocap.toml").write_text(SCENE)
    overrides = {"integrator": options.pop("integrator")} if "integrator" in options else None
    return load_scene(folder / "mocap.toml", overrides=overrides, friction=options.get("friction"))


def test_velocity_is_what_was_set(tmp_path: Path) -> None:
    scene = mocap_scene(tmp_path)
    sim = Simulator(scene)
    paddle, others = [0, 0, -0.05, 1, 0, 0, 0], [0, 0.01, 0.02, 0.05, 1, 0, 0, 0, 0, 0.5, 0, 1, 0, 0, 0]
    assert Simulator(scene.build()).q[0].tolist() == [0, *paddle, *others]
    assert sim.q[0].tolist() == scene.q0.tolist() == [0.3, *paddle, *others]
    sim.v[0, scene.v("paddle")] = TWIST
    for _ in range(300):
        sim.step(np.zeros((1, 0)))
    assert sim.status[0] == 0
    assert sim.v[0, scene.v("paddle")].tolist() == TWIST
    moved = sim.q[0, scene.q("paddle")][:3] - [0, 0, -0.05]
    assert moved == pytest.approx(0.3 * np.array(TWIST[:3]), abs=1e-12)
    # The part is lifted by contact, and a body with a weld follows at the same velocity.
    assert sim.q[0, sim.joint_q("part") + 2] == pytest.approx(0.08, abs=0.01)
    assert sim.v[0, scene.v("carried")][3:] == pytest.approx(TWIST[3:], abs=0.02)


def test_description(tmp_path: Path) -> None:
    paddle = next(body for body in describe(mocap_scene(tmp_path)).bodies if body.name == "paddle")
    assert [joint.prescribed for joint in paddle.joints] == [True]


def test_body_is_moved_between_steps(tmp_path: Path) -> None:
    """As `mocap_pos` of MuJoCo: the pose is set, the velocity is 0."""
    scene = mocap_scene(tmp_path)
    sim = Simulator(scene)
    for step in range(100):
        sim.q[0, sim.joint_q("paddle") + 2] = -0.05 - 1e-4 * step
        sim.step(np.zeros((1, 0)))
    assert sim.status[0] == 0 and not sim.v[0, scene.v("paddle")].any()
    assert sim.q[0, sim.joint_q("part") + 2] == pytest.approx(0.05 - 0.0099, abs=2e-3)


def test_joint_with_the_name_of_a_mocap_body_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mocap.xml").write_text(MODEL.replace('joint name="before"', 'joint name="paddle"'))
    with pytest.raises(UsageError, match="mocap body 'paddle' gets a free joint of its name, but the model has"):
        load_scene(tmp_path / "mocap.xml")


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("law", FRICTION_LAWS)
def test_gradients(law: str, integrator: str, tmp_path: Path) -> None:
    scene = mocap_scene(tmp_path, integrator=integrator, friction=law)
    rng = np.random.default_rng(0)
    for output in ("q", "v"):
        sim = Simulator(scene)
        sim.v[0, scene.v("paddle")] = TWIST
        for _ in range(20):
            sim.step(np.zeros((1, 0)))
        case = gradient_check.RolloutLoss.random(sim, np.zeros((8, 0)), output, rng)
        assert gradient_check.compare_to_dual_numbers(case, rng, directions=2).error < 1e-10
        agreement = gradient_check.compare_to_differences(case, params=False)
        assert agreement.error < 1e-6 and agreement.skipped <= 0.05


def test_total_mass_beside_a_mocap_body_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mocap.xml"
    path.write_text(MODEL.replace("<mujoco>", '<mujoco><compiler settotalmass="2"/>'))
    with pytest.raises(UsageError, match=r"mocap\.xml: settotalmass and mocap bodies exclude each other"):
        load_scene(path)
