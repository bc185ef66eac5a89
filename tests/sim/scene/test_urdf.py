"""URDF files as found in the wild: addresses of meshes, impossible inertia, transmissions; model files as scenes."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.sim.scene.test_mjcf import write_stl

from gelflow.cli.main import main
from gelflow.errors import UsageError
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator

LINK = """<link name="{name}"><inertial><mass value="1"/><origin xyz="0 0 0.1" rpy="0.3 0.2 0.1"/>
  <inertia ixx="{ixx}" iyy="0.02" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial>{geometry}</link>"""
MESH = '<collision><geometry><mesh filename="{}"/></geometry></collision>'
JOINT = """<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/><axis xyz="0 0 1"/>
  <limit lower="-1" upper="1" effort="2" velocity="1"/></joint>"""


def robot(path: Path, *, mesh: str = "", ixx: float = 0.02, more: str = "") -> Path:
    """A URDF file of two links on a base."""
    geometry = MESH.format(mesh) if mesh else ""
    links = LINK.format(name="a", ixx=ixx, geometry=geometry) + LINK.format(name="b", ixx=0.02, geometry="")
    joints = JOINT.format(name="ja", parent="base", child="a") + JOINT.format(name="jb", parent="a", child="b")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f'<robot name="r"><link name="base"/>{links}{joints}{more}</robot>')
    return path


def matrix(packed: NDArray[np.float64]) -> NDArray[np.float64]:
    xx, yy, zz, xy, xz, yz = packed
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@pytest.mark.parametrize(
    ("address", "file"),
    [
        ("meshes/link.stl", "ws/arm/urdf/meshes/link.stl"),
        ("meshes/link.stl", "ws/arm/meshes/link.stl"),
        ("package://arm/meshes/link.stl", "ws/arm/meshes/link.stl"),
        ("package://arm/meshes/link.stl", "ws/arm/urdf/meshes/link.stl"),
        ("package://other/meshes/link.stl", "ws/other/meshes/link.stl"),
        ("package://renamed/meshes/link.stl", "ws/arm/meshes/link.stl"),
        ("package://far/meshes/link.stl", "ros/far/meshes/link.stl"),
        ("package://ros/meshes/link.stl", "ros/meshes/link.stl"),
    ],
)
def test_mesh_is_found(address: str, file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_stl(tmp_path / file)
    monkeypatch.setenv("ROS_PACKAGE_PATH", f"{tmp_path / 'none'}:{tmp_path / 'ros'}")
    scene = load_scene(robot(tmp_path / "ws/arm/urdf/arm.urdf", mesh=address))
    assert [j.name for j in scene.joints] == ["ja", "jb"]


def test_meshes_of_one_file_name_in_two_folders_are_two(tmp_path: Path) -> None:
    """Robots from two packages have a base.stl each; MuJoCo would use one of them for both."""
    write_stl(tmp_path / "arm/base.stl", 0.1)
    write_stl(tmp_path / "gripper/base.stl", 0.3)
    path = robot(tmp_path / "arm.urdf", mesh="arm/base.stl")
    hand = LINK.format(name="c", ixx=0.02, geometry=MESH.format("package://gripper/base.stl"))
    joint = JOINT.format(name="jc", parent="b", child="c")
    path.write_text(path.read_text().replace("</robot>", f"{hand}{joint}</robot>"))
    meshes = [geom.mesh for geom in load_scene(path).geoms]
    assert [round(float(np.ptp(mesh.vertices, axis=0).max()), 3) for mesh in meshes if mesh] == [
        pytest.approx(size, rel=0.5) for size in (0.1, 0.3)
    ]


def test_default_namespace_changes_nothing(tmp_path: Path) -> None:
    path = robot(tmp_path / "arm.urdf")
    path.write_text(path.read_text().replace("<robot", '<robot xmlns="http://drake.mit.edu"'))
    assert [a.name for a in load_scene(path).actuators] == ["ja", "jb"]


def test_collision_geometry_gives_no_mass_unless_the_file_asks_for_it(tmp_path: Path) -> None:
    path = robot(tmp_path / "arm.urdf")
    box = '<collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision>'
    last = f'<link name="c">{box}</link>' + JOINT.format(name="jc", parent="b", child="c")
    path.write_text(path.read_text().replace("</robot>", f"{last}</robot>"))
    with pytest.raises(UsageError, match="link 'c' moves without any mass; give it an <inertial>, or"):
        load_scene(path)
    wanted = '<mujoco><compiler inertiafromgeom="true"/></mujoco></robot>'
    path.write_text(path.read_text().replace("</robot>", wanted))
    assert load_scene(path).bodies[-1].mass == pytest.approx(1.0)


def test_missing_mesh_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no file package://arm/link\.stl"):
        load_scene(robot(tmp_path / "arm.urdf", mesh="package://arm/link.stl"))


def test_inertia_that_breaks_the_triangle_inequality_is_repaired(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"link 'a'.* by 0\.009 kg m² \(30 % of the largest\)"):
        scene = load_scene(robot(tmp_path / "arm.urdf", ixx=0.001))
    repaired = np.linalg.eigvalsh(matrix(scene.bodies[0].inertia))
    np.testing.assert_allclose(repaired, [0.0055, 0.0245, 0.03], rtol=1e-9)  # a + b = c, the excess shared equally
    sim = Simulator(scene)
    sim.step(np.zeros(2), 100)
    assert (sim.status == 0).all()


def test_possible_inertia_is_kept(tmp_path: Path) -> None:
    path = robot(tmp_path / "arm.urdf", ixx=0.01)  # a + b = c
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_scene(path)
    np.testing.assert_allclose(np.linalg.eigvalsh(matrix(scene.bodies[0].inertia)), [0.01, 0.02, 0.03], rtol=1e-9)


@pytest.mark.parametrize("ixx", [0.0, -1e-19, -0.005, -0.01])
def test_inertia_without_or_below_zero_is_repaired(ixx: float, tmp_path: Path) -> None:
    """Rods without thickness, and the rounding errors of a computer-aided design: both are in published robots."""
    with pytest.warns(UserWarning, match=r"link 'a': principal inertias .* break the triangle inequality by"):
        scene = load_scene(robot(tmp_path / "arm.urdf", ixx=ixx))
    principal = np.linalg.eigvalsh(matrix(scene.bodies[0].inertia))
    assert principal[0] > 0
    assert principal[0] + principal[1] >= principal[2] * (1 - 1e-12)
    sim = Simulator(scene)
    sim.step(np.zeros(2), 100)
    assert (sim.status == 0).all()


def test_inertia_that_is_nowhere_positive_is_refused(tmp_path: Path) -> None:
    path = robot(tmp_path / "arm.urdf", ixx=-0.01)
    path.write_text(path.read_text().replace('"0.02"', '"-0.02"').replace('"0.03"', '"-0.03"'))
    with pytest.raises(UsageError, match=r"link 'a': principal inertias must be positive, got -0\.03, -0\.02, -0\.01"):
        load_scene(path)


def test_inertia_of_what_does_not_move_is_repaired_without_a_warning(tmp_path: Path) -> None:
    path = robot(tmp_path / "arm.urdf")
    base = LINK.format(name="base", ixx=0, geometry="").replace("0.02", "0")
    path.write_text(path.read_text().replace('<link name="base"/>', base))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_scene(path)


def test_links_without_mass_between_two_joints_move_as_if_they_were_not_there(tmp_path: Path) -> None:
    """Real robots have such links where two joints cross in a point: the base of a thumb, the wrist of an arm."""
    arm, rod = tmp_path / "arm.urdf", LINK.format(name="b", ixx=0.02, geometry="")
    crossed = JOINT.format(name="ja", parent="base", child="a") + JOINT.format(name="jb", parent="a", child="b")
    crossed = crossed.replace("0 0 1", "1 0 0", 1).replace("0 0 1", "0 1 0", 1)
    arm.write_text(f'<robot name="r"><link name="base"/><link name="a"/>{rod}{crossed}</robot>')
    with pytest.warns(UserWarning, match=r"arm\.urdf: moving links without mass or without inertia: a; simulated"):
        scene = load_scene(arm, overrides={"step": 1e-3})
    one_body = tmp_path / "arm.xml"
    inertia = " ".join(f"{value:.17g}" for value in scene.bodies[1].inertia)
    one_body.write_text(f"""<mujoco><compiler angle="radian"/><option timestep="0.001"/><worldbody><body>
      <joint axis="1 0 0" range="-1 1"/><joint axis="0 1 0" range="-1 1"/>
      <inertial pos="0 0 0.1" mass="1" fullinertia="{inertia}"/></body></worldbody></mujoco>""")
    tilts = []
    for sim in (Simulator(scene), Simulator(load_scene(one_body))):
        sim.q[0, 0] = 0.1
        sim.step(np.zeros(sim.model.nu), 400)
        tilts.append(sim.q[0].copy())
    assert tilts[0][0] > 0.4
    np.testing.assert_allclose(tilts[0], tilts[1], atol=1e-6)


def test_link_that_moves_without_any_mass_is_refused(tmp_path: Path) -> None:
    path = robot(tmp_path / "arm.urdf")
    last = '<link name="c"/>' + JOINT.format(name="jc", parent="b", child="c")
    path.write_text(path.read_text().replace("</robot>", f"{last}</robot>"))
    with pytest.raises(UsageError, match=r"arm\.urdf: link 'c' moves without any mass; give it an <inertial>"):
        load_scene(path)


TRANSMISSION = '<transmission name="t"><joint name="ja"/><joint name="jb"/>{}</transmission>'


@pytest.mark.parametrize(
    ("actuators", "names"),
    [
        ('<actuator name="m1"/><actuator name="m2"/>', ["m1", "m2"]),
        ('<actuator name="m"/>', ["m/ja", "m/jb"]),
        ('<actuator name="m"/><actuator name="m"/>', ["m/ja", "m/jb"]),
        ("", ["ja", "jb"]),
    ],
)
def test_joints_of_a_transmission_have_actuators_of_their_own(actuators: str, names: list[str], tmp_path: Path) -> None:
    scene = load_scene(robot(tmp_path / "arm.urdf", more=TRANSMISSION.format(actuators)))
    assert [a.name for a in scene.actuators] == names
    assert Simulator(scene).model.nu == 2


def test_control_that_only_measures_has_no_motor(tmp_path: Path) -> None:
    control = '<ros2_control><joint name="ja"><state_interface name="position"/></joint></ros2_control>'
    assert not load_scene(robot(tmp_path / "arm.urdf", more=control)).actuators


def test_motor_of_an_unknown_joint_is_refused(tmp_path: Path) -> None:
    motor = '<transmission name="t"><joint name="jx"/></transmission>'
    with pytest.raises(UsageError, match=r"arm\.urdf: a motor drives joint 'jx', which the file does not have"):
        load_scene(robot(tmp_path / "arm.urdf", more=motor))


def test_continuous_joint_has_no_range(tmp_path: Path) -> None:
    path = robot(tmp_path / "arm.urdf")
    path.write_text(path.read_text().replace("revolute", "continuous", 1))
    assert [joint.range for joint in load_scene(path).joints] == [None, (-1.0, 1.0)]


@pytest.mark.parametrize(("lower", "upper"), [(1, -1), (0.5, 0.5)])
def test_range_without_extent_is_refused(lower: float, upper: float, tmp_path: Path) -> None:
    path = robot(tmp_path / "arm.urdf")
    path.write_text(path.read_text().replace('lower="-1" upper="1"', f'lower="{lower}" upper="{upper}"', 1))
    with pytest.raises(UsageError, match=f"joint 'ja': lower limit {lower:g} must be below upper limit {upper:g}"):
        load_scene(path)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("still.urdf", '<robot name="r"><link name="base"/></robot>'),
        ("still.xml", '<mujoco><worldbody><geom size="1"/></worldbody></mujoco>'),
    ],
)
def test_model_without_a_joint_is_refused(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(UsageError, match="the model has no joint"):
        load_scene(tmp_path / name)


def test_file_that_is_no_scene_is_refused_with_the_valid_suffixes(tmp_path: Path) -> None:
    xacro = robot(tmp_path / "arm.urdf.xacro")
    with pytest.raises(UsageError, match=r"a scene is a \.toml file, .*; run xacro and load its output"):
        load_scene(xacro)
    scene = tmp_path / "s.toml"
    scene.write_text('format = 1\nmodel = "arm.urdf.xacro"\nstep = 1e-3\n')
    with pytest.raises(UsageError, match=r": arm.urdf.xacro must have the suffix \.xml \(MJCF\) or \.urdf"):
        load_scene(scene)


def test_model_file_is_a_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "robot.xml"
    body = '<body><joint name="j"/><geom size="0.1"/></body>'
    path.write_text(f'<mujoco><option timestep="0.004"/><worldbody>{body}</worldbody></mujoco>')
    scene = load_scene(path)
    assert (scene.name, scene.step, scene.contacts, scene.pads) == ("robot", 0.004, (), ())
    assert load_scene(path, overrides={"step": 0.001, "integrator": "bdf2"}).step == 0.001
    assert main(["describe", str(path), "--no-timing"]) == 0
    assert "robot" in capsys.readouterr().out
    with pytest.raises(UsageError, match="no such model file"):
        load_scene(tmp_path / "missing.urdf")


@pytest.mark.parametrize(
    ("kind", "limit", "message"),
    [
        ("revolute", 'lower="nan" upper="1"', "joint 'jb': lower limit nan must be below upper limit 1"),
        ("revolute", 'lower="-1" upper="1" effort="-3"', "joint 'jb': the effort of <limit> must not be negative"),
        ("floating", 'lower="-1" upper="1"', "joint 'jb' is floating, so its parent must be called 'world', got 'a'"),
    ],
)
def test_limits_and_joints_that_cannot_be_simulated(kind: str, limit: str, message: str, tmp_path: Path) -> None:
    path = robot(tmp_path / "arm.urdf")
    before, after = path.read_text().split('<joint name="jb" type="revolute">')
    after = after.replace('lower="-1" upper="1" effort="2"', limit)
    path.write_text(f'{before}<joint name="jb" type="{kind}">{after}')
    with pytest.raises(UsageError, match=message):
        load_scene(path)
