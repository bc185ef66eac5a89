"""Couplings of model files: joint equalities, <mimic>, fixed tendons, connect and weld, compared with MuJoCo."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from tests.sim.scene.test_mjcf import JOINT, check_against_mujoco

from gelflow.geometry import Pose
from gelflow.sim.benchmark.describe import describe
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.simulator import Simulator

HAND = """<mujoco model="hand">
  <default><default class="finger"><joint axis="0 1 0" range="0 0.04" type="slide" armature="0.1"/></default></default>
  <worldbody>
    <body name="hand">
      <geom type="box" size="0.03 0.1 0.03"/>
      <body name="left"><joint name="finger_1" class="finger"/><geom size="0.01"/></body>
      <body name="right" quat="0 0 0 1"><joint name="finger_2" class="finger"/><geom size="0.01"/></body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="split"><joint joint="finger_1" coef="0.5"/><joint joint="finger_2" coef="0.5"/></fixed>
  </tendon>
  <equality><joint joint1="finger_1" joint2="finger_2"/></equality>
  <actuator><general name="grip" tendon="split" ctrlrange="0 255" gainprm="0.016 0 0" biasprm="0 -100 -10"/></actuator>
</mujoco>"""

LOOP = """<mujoco>
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <body name="crank">
      <joint name="crank" axis="0 1 0" damping="0.01"/>
      <geom type="capsule" size="0.01" fromto="0 0 0 0.05 0 0.08" mass="0.2"/>
      <body name="rod" pos="0.05 0 0.08">
        <joint name="rod" axis="0 1 0"/><geom type="capsule" size="0.01" fromto="0 0 0 0.15 0 0.02" mass="0.2"/>
        <site name="rod tip" pos="0.15 0 0.02"/>
      </body>
    </body>
    <body name="rocker" pos="0.2 0 0">
      <joint name="rocker" axis="0 1 0"/><geom type="capsule" size="0.01" fromto="0 0 0 0 0 0.1" mass="0.2"/>
      <site name="rocker tip" pos="0 0 0.1"/>
    </body>
  </worldbody>
  <equality>EQUALITY</equality>
  <actuator><motor name="crank" joint="crank"/></actuator>
</mujoco>"""
CONNECT = '<connect body1="rod" body2="rocker" anchor="0.15 0 0.02" solref="0.001 1" solimp="0.9999 0.9999 0.001"/>'
CONNECT_SITES = '<connect site1="rod tip" site2="rocker tip" solref="0.001 1" solimp="0.9999 0.9999 0.001"/>'
LINEAR = '<joint joint1="rocker" joint2="crank" polycoef="0.1 -1.5"/>'
WELD = '<weld body1="rod" body2="rocker" anchor="0 0 0.1" solref="0.001 1" solimp="0.9999 0.9999 0.001"/>'


def load(folder: Path, model: str, text: str, more: str = "") -> Scene:
    (folder / model).write_text(text)
    (folder / "scene.toml").write_text(f'format = 1\nmodel = "{model}"\nstep = 1e-3\nintegrator = "bdf2"\n{more}')
    return load_scene(folder / "scene.toml")


def in_mujoco(path: Path, u: float, seconds: float) -> np.ndarray:
    """Joint positions after motion with a constant control."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.timestep = 1e-4
    model.geom_contype[:] = model.geom_conaffinity[:] = 0
    data = mujoco.MjData(model)
    data.ctrl[:] = u
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
    return np.array(data.qpos)


def moved(scene: Scene, u: float, steps: int) -> Simulator:
    sim = Simulator(scene)
    sim.step(np.full((1, scene.nu), u), steps)
    sim.check()
    return sim


def test_hand_with_coupled_fingers_moves_as_one(tmp_path: Path) -> None:
    scene = load(tmp_path, "hand.xml", HAND)
    assert (scene.nv, scene.nu) == (2, 1)
    sim = moved(scene, 100.0, 50)
    assert sim.q[0, 0] == sim.q[0, 1], "coupled exactly"
    assert sim.q[0, 0] == pytest.approx(in_mujoco(tmp_path / "hand.xml", 100.0, 0.05)[0], abs=2e-5)


@pytest.mark.parametrize("equality", [CONNECT, CONNECT_SITES])
def test_closed_four_bar_moves_as_in_mujoco(equality: str, tmp_path: Path) -> None:
    scene = load(tmp_path, "loop.xml", LOOP.replace("EQUALITY", equality))
    sim = moved(scene, 0.3, 80)
    expected = in_mujoco(tmp_path / "loop.xml", 0.3, 0.08)
    assert abs(expected[0]) > 0.1, "it moves"
    assert sim.q[0] == pytest.approx(expected, abs=1e-3)


def test_weld_makes_a_loop_rigid(tmp_path: Path) -> None:
    sim = moved(load(tmp_path, "loop.xml", LOOP.replace("EQUALITY", WELD)), 0.3, 200)
    assert np.abs(sim.q).max() < 1e-3


@pytest.mark.parametrize("gear", [2, -0.5])
def test_force_range_of_a_tendon_limits_the_force_before_the_gear(gear: float, tmp_path: Path) -> None:
    tendon = '<tendon><fixed name="t" actuatorfrcrange="-0.5 1"><joint joint="j" coef="3"/></fixed></tendon>'
    actuators = f'<motor tendon="t" gear="{gear}"/></actuator>{tendon}<actuator>'
    scene = load(tmp_path, "joint.xml", JOINT.format(joint="", actuators=actuators))
    check_against_mujoco(scene, mujoco.MjModel.from_xml_path(str(tmp_path / "joint.xml")))


def test_weld_with_torquescale_0_is_a_connect(tmp_path: Path) -> None:
    weld = WELD.replace("anchor", 'torquescale="0" anchor')
    sims = [moved(load(tmp_path, "loop.xml", LOOP.replace("EQUALITY", e)), 0.3, 200) for e in (weld, CONNECT)]
    np.testing.assert_allclose(sims[0].q, sims[1].q, atol=1e-9)
    assert np.abs(sims[0].q).max() > 0.1


def test_loop_closes_to_the_stated_compliance(tmp_path: Path) -> None:
    """The gap is the force over 1e7 N/m."""
    scene = load(tmp_path, "loop.xml", LOOP.replace("EQUALITY", CONNECT))
    sim = moved(scene, 0.3, 200)
    sites = {site.name: index for index, site in enumerate(scene.sites)}
    poses = sim.site_poses()[0]
    gap = np.linalg.norm(poses[sites["rod tip"], :3] - poses[sites["rocker tip"], :3])
    assert gap < 100.0 / 1e7


@pytest.mark.parametrize("coefficients", ["0.1 0.5", "0.1 0.5 2 -1 0.3", "0.2 0"])
def test_joint_equality_holds_for_any_polynomial(coefficients: str, tmp_path: Path) -> None:
    equality = f'<joint joint1="rocker" joint2="crank" polycoef="{coefficients}"/>'
    scene = load(tmp_path, "loop.xml", LOOP.replace("EQUALITY", equality))
    sim = moved(scene, 0.3, 150)
    crank, _, rocker = sim.q[0]
    linear = len(coefficients.split()) <= 2
    expected = np.polynomial.polynomial.polyval(crank, [float(c) for c in coefficients.split()])
    assert rocker == pytest.approx(expected, abs=1e-12 if linear else 1e-3)


def test_joint_equality_without_a_second_joint_fixes_it(tmp_path: Path) -> None:
    equality = '<joint joint1="rocker" polycoef="0.2"/>'
    sim = moved(load(tmp_path, "loop.xml", LOOP.replace("EQUALITY", equality)), 0.3, 50)
    assert sim.q[0, 2] == 0.2
    assert sim.v[0, 2] == 0


def test_positions_set_for_a_follower_are_those_of_its_leader(tmp_path: Path) -> None:
    equality = '<joint joint1="rocker" joint2="crank" polycoef="0.1 0.5"/>'
    sim = Simulator(load(tmp_path, "loop.xml", LOOP.replace("EQUALITY", equality)))
    assert sim.q[0, 2] == 0.1
    sim.q[0], sim.v[0] = [0.4, 0.0, -3.0], [0.2, 0.0, 9.0]
    sim.step(np.zeros((1, 1)))
    assert sim.q[0, 2] == pytest.approx(0.1 + 0.5 * sim.q[0, 0], abs=1e-15)
    assert sim.v[0, 2] == 0.5 * sim.v[0, 0]


@pytest.mark.parametrize(
    "read", [Simulator.poses, Simulator.site_poses, Simulator.mass_matrix, Simulator.bias, Simulator.contact_forces]
)
def test_readings_follow_the_leader_before_the_next_step(
    read: Callable[[Simulator], np.ndarray], tmp_path: Path
) -> None:
    equality = '<joint joint1="rocker" joint2="crank" polycoef="0.1 0.5"/>'
    scene = load(tmp_path, "loop.xml", LOOP.replace("EQUALITY", equality))
    results = []
    for steps in (None, 0):
        sim = Simulator(scene)
        sim.q[0], sim.v[0] = [0.4, 0.2, -3.0], [0.2, 0.1, 9.0]
        if steps == 0:
            sim.step(np.zeros(1), 0)
        results.append(read(sim))
        assert sim.q[0, 2] == 0.1 + 0.5 * 0.4
    np.testing.assert_array_equal(results[0], results[1])


def test_description_lists_couplings(tmp_path: Path) -> None:
    hand = describe(load(tmp_path, "hand.xml", HAND))
    assert hand.couplings == ("finger_1 = 1 finger_2 (exact)", "tendon split = 0.5 finger_1 + 0.5 finger_2")
    loop = describe(load(tmp_path, "loop.xml", LOOP.replace("EQUALITY", CONNECT + LINEAR)))
    assert loop.couplings == ("rocker = 0.1 + -1.5 crank (exact)", "connect equality0: rod to rocker")


def energy(sim: Simulator, scene: Scene) -> float:
    """Kinetic and potential energy [J]."""
    kinetic = 0.5 * float(sim.v[0] @ sim.mass_matrix()[0] @ sim.v[0])
    poses = (Pose(pose[:3], pose[3:]) for pose in sim.poses()[0])
    heights = [pose.apply(body.com)[2] for pose, body in zip(poses, scene.bodies, strict=True)]
    potential = 9.81 * sum(body.mass * float(z) for body, z in zip(scene.bodies, heights, strict=True))
    return kinetic + potential


@pytest.mark.parametrize(
    "equality",
    [CONNECT, LINEAR, LINEAR.replace("0.1 -1.5", "0 1 0.3")],
)
def test_falling_mechanism_keeps_its_energy(equality: str, tmp_path: Path) -> None:
    text = LOOP.replace("EQUALITY", equality).replace(' damping="0.01"', "")
    scene = load(tmp_path, "loop.xml", text)
    sim = Simulator(replace(scene, step=2e-4))
    start = energy(sim, scene)
    lowest = np.inf
    for _ in range(10):
        sim.step(np.zeros((1, 1)), 100)
        kinetic = 0.5 * float(sim.v[0] @ sim.mass_matrix()[0] @ sim.v[0])
        lowest = min(lowest, energy(sim, scene) - kinetic)
        assert energy(sim, scene) == pytest.approx(start, abs=2e-3 * max(start - lowest, 1e-3))
    assert start - lowest > 0.05, "it fell"


LINK = """<link name="{}"><inertial><mass value="1"/>
  <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
URDF = f"""<robot name="gripper"><link name="base"/>{LINK.format("left")}{LINK.format("right")}
  <joint name="a" type="continuous"><parent link="base"/><child link="left"/><axis xyz="0 0 1"/></joint>
  <joint name="b" type="continuous"><parent link="base"/><child link="right"/><axis xyz="0 0 1"/>
    <mimic joint="a" multiplier="-2" offset="0.1"/></joint></robot>"""


def test_mimic_joint_follows_and_has_no_motor(tmp_path: Path) -> None:
    scene = load(tmp_path, "gripper.urdf", URDF)
    assert [a.name for a in scene.actuators] == ["a"]
    sim = moved(scene, 0.5, 100)
    assert sim.q[0, 1] == pytest.approx(0.1 - 2 * sim.q[0, 0], abs=1e-14)
    # The follower adds multiplier² times its inertia.
    assert sim.v[0, 0] == pytest.approx(0.5 * 0.1 / (0.1 + 4 * 0.1), rel=1e-6)


@pytest.mark.parametrize(
    ("equality", "message"),
    [
        ('<joint joint1="rod" joint2="crank"/><joint joint1="rod" joint2="rocker"/>', "joint 'rod' follows two joints"),
        ('<joint joint1="rod" joint2="crank"/><joint joint1="crank" joint2="rod"/>', "the joint follows itself"),
    ],
)
def test_impossible_couplings_are_refused(equality: str, message: str, tmp_path: Path) -> None:
    scene = load(tmp_path, "loop.xml", LOOP.replace("EQUALITY", equality))
    with pytest.raises(ValueError, match=message):
        scene.build()
