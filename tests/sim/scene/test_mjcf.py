"""Model files in the style of public collections: loading, and agreement with the dynamics of MuJoCo."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.simulator import Simulator

Array = NDArray[np.float64]

ARM = {
    "scene.xml": """<mujoco model="arm scene">
  <include file="arm.xml"/>
  <visual><headlight diffuse="0.6 0.6 0.6"/></visual>
  <asset><texture type="skybox" builtin="gradient" width="8" height="48"/></asset>
  <worldbody><light pos="0 0 1.5"/><geom name="floor" type="plane" size="0 0 0.05"/></worldbody>
</mujoco>""",
    "arm.xml": """<mujoco model="arm">
  <compiler angle="radian" meshdir="assets" autolimits="true"/>
  <option integrator="implicitfast"/>
  <default>
    <default class="arm">
      <joint axis="0 1 0" range="-6.28319 6.28319" armature="0.1" damping="0.5"/>
      <general gaintype="fixed" biastype="affine" ctrlrange="-6.2831 6.2831" gainprm="2000" biasprm="0 -2000 -400"
        forcerange="-150 150"/>
      <default class="large"><joint range="-3.1415 3.1415"/></default>
      <default class="wrist">
        <joint armature="0.01" damping="0.1" frictionloss="0.3"/>
        <general gainprm="500" biasprm="0 -500 -100" forcerange="-28 28"/>
      </default>
      <default class="visual"><geom type="mesh" contype="0" conaffinity="0" group="2"/></default>
      <default class="collision"><geom type="capsule" group="3"/></default>
    </default>
  </default>
  <asset><material name="grey" rgba="0.5 0.5 0.5 1"/><mesh file="link.stl" scale="0.5 0.5 0.5"/></asset>
  <worldbody>
    <body name="base" childclass="arm">
      <inertial mass="4" pos="0 0 0" diaginertia="0.01 0.01 0.01"/>
      <geom mesh="link" material="grey" class="visual"/>
      <body name="shoulder" pos="0 0 0.16">
        <inertial mass="3.7" pos="0 0 0" diaginertia="0.0103 0.0103 0.0067"/>
        <joint name="shoulder_pan" class="large" axis="0 0 1"/>
        <geom mesh="link" class="visual"/>
        <body name="upper_arm" pos="0 0.138 0" quat="1 0 1 0">
          <inertial mass="8.4" pos="0 0 0.21" diaginertia="0.13 0.13 0.015"/>
          <joint name="shoulder_lift"/>
          <geom mesh="link" class="visual"/>
          <geom class="collision" size="0.06 0.2" pos="0 0 0.2"/>
          <body name="forearm" pos="0 -0.131 0.425">
            <inertial mass="2.3" pos="0 0 0.2" diaginertia="0.03 0.03 0.004"/>
            <joint name="elbow" class="large"/>
            <body name="wrist_1" pos="0 0 0.392" quat="1 0 1 0">
              <inertial mass="1.2" pos="0 0.127 0" diaginertia="0.0026 0.0026 0.0022"/>
              <joint name="wrist_1" class="wrist"/>
              <body name="wrist_2" pos="0 0.127 0">
                <inertial mass="1.2" pos="0 0 0.1" diaginertia="0.0026 0.0026 0.0022"/>
                <joint name="wrist_2" class="wrist" axis="0 0 1"/>
                <body name="wrist_3" pos="0 0 0.1">
                  <inertial mass="0.19" pos="0 0.08 0" diaginertia="1e-4 1e-4 1.3e-4"/>
                  <joint name="wrist_3" class="wrist"/>
                  <geom class="collision" size="0.04 0.02" pos="0 0.08 0"/>
                  <body name="tool" pos="0 0.1 0" quat="-1 1 0 0"><geom size="0.01" mass="0.05"/></body>
                  <site name="attachment" pos="0 0.1 0" quat="-1 1 0 0"/>
                </body>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <contact><exclude body1="base" body2="shoulder"/></contact>
  <sensor><jointpos joint="elbow"/></sensor>
  <actuator>
    <general class="arm" name="shoulder_pan" joint="shoulder_pan"/>
    <general class="arm" name="shoulder_lift" joint="shoulder_lift"/>
    <general class="arm" name="elbow" joint="elbow"/>
    <position class="wrist" name="wrist_1" joint="wrist_1" kp="500" dampratio="1"/>
    <position class="wrist" name="wrist_2" joint="wrist_2" kp="500" kv="100"/>
    <general class="wrist" joint="wrist_3"/>
  </actuator>
  <keyframe><key name="home" qpos="-1.5708 -1.5708 1.5708 -1.5708 -1.5708 0" ctrl="0 0 0 0 0 0"/></keyframe>
</mujoco>""",
}

ROVER = {
    "scene.xml": """<mujoco model="rover">
  <default>
    <default class="wheel">
      <joint axis="0 1 0" damping="0.01" frictionloss="0.05" armature="0.002"/>
      <velocity kv="2" gear="5" ctrlrange="-12 12" forcerange="-4 4"/>
      <geom type="cylinder" size="0.08 0.02" density="500" zaxis="0 1 0"/>
    </default>
  </default>
  <worldbody>
    <body name="rover" pos="0 0 0.1">
      <freejoint/>
      <geom type="box" size="0.2 0.15 0.05" density="300"/>
      <body name="left" pos="0 0.2 0"><joint name="left" class="wheel"/><geom class="wheel"/></body>
      <body name="right" pos="0 -0.2 0"><joint name="right" class="wheel"/><geom class="wheel"/></body>
      <body name="caster" pos="-0.2 0 0.02">
        <joint name="caster" type="ball" pos="0.01 0 0.02" damping="0.001" armature="1e-4" frictionloss="0.002"/>
        <geom size="0.03" pos="0 0 -0.02"/>
      </body>
      <body pos="0.2 0 0.05">
        <joint name="mast" axis="0 1 0" ref="30" springref="10" stiffness="4" damping="0.2"/>
        <joint type="slide" axis="0 0 1" ref="0.1" range="-0.5 0.5" stiffness="50" springref="0.02"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.4" size="0.02"/>
      </body>
    </body>
  </worldbody>
  <actuator><velocity class="wheel" joint="left"/><velocity class="wheel" joint="right"/></actuator>
</mujoco>""",
}

INERTIAL = """<inertial><origin xyz="0 0 0.1"/><mass value="{}"/>
    <inertia ixx="0.02" iyy="0.02" izz="0.01" ixy="0.001" ixz="0" iyz="0"/></inertial>"""
URDF = f"""<robot name="arm">
  <link name="world"/>
  <link name="base"><visual><geometry><mesh filename="package://my_arm/meshes/base.dae"/></geometry></visual></link>
  <link name="upper">{INERTIAL.format(2)}
    <collision name="c"><geometry><mesh filename="package://my_arm/meshes/link.stl" scale="0.5 0.5 0.5"/></geometry>
    </collision></link>
  <link name="lower">{INERTIAL.format(1)}<collision><geometry><sphere radius="0.05"/></geometry></collision></link>
  <link name="slider">{INERTIAL.format(0.5)}</link>
  <link name="tcp"/>
  <joint name="mount" type="fixed"><parent link="world"/><child link="base"/><origin xyz="0 0 0.5"/></joint>
  <joint name="turn" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
    <limit effort="10" velocity="3"/><dynamics damping="0.4" friction="0.2"/></joint>
  <joint name="lift" type="revolute"><parent link="upper"/><child link="lower"/><axis xyz="0 1 0"/>
    <origin xyz="0 0 0.3" rpy="0.1 0.2 0.3"/><limit lower="-2" upper="2" effort="5" velocity="3"/></joint>
  <joint name="slide" type="prismatic"><parent link="lower"/><child link="slider"/><axis xyz="1 0 0"/>
    <limit lower="-0.5" upper="0.5" effort="0" velocity="1"/></joint>
  <joint name="tool" type="fixed"><parent link="slider"/><child link="tcp"/><origin xyz="0 0 0.2"/></joint>
  <gazebo reference="upper"><material>Gazebo/Grey</material></gazebo>
</robot>"""
TRANSMISSION = """<transmission name="t"><type>transmission_interface/SimpleTransmission</type>
  <joint name="lift"><hardwareInterface>hardware_interface/EffortJointInterface</hardwareInterface></joint>
  <actuator name="lift_motor"><mechanicalReduction>50</mechanicalReduction></actuator></transmission>"""
CONTROL = """<ros2_control name="c" type="system"><joint name="turn"><command_interface name="effort"/></joint>
  <joint name="slide"><state_interface name="position"/></joint></ros2_control>"""


def write(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def write_stl(path: Path, size: float = 0.1) -> None:
    """A tetrahedron."""
    corners = size * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.zeros(4, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("color", "<u2")]))
    faces["corners"] = corners[[[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"\0" * 80 + np.uint32(4).tobytes() + faces.tobytes())


def load(folder: Path, model: str = "scene.xml", more: str = "") -> Scene:
    (folder / "scene.toml").write_text(f'format = 1\nmodel = "{model}"\nstep = 0.002\n{more}')
    return load_scene(folder / "scene.toml")


def check_against_mujoco(scene: Scene, model: Any, steps: int = 20, seed: int = 0) -> None:
    """Compare with MuJoCo: mass matrix and bias at random states, and the equation of each of `steps` steps.

    A step satisfies M(q₁) (v₁ − v*) / (β h) = f(q₁, v₁, u) − C(q₁, v₁) with M, C and f of MuJoCo, and β and v* of the
    scene's integrator (docs/reference/physics.md, "Equations"). No joint reaches its range.
    """
    rng = np.random.default_rng(seed)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    data, sim = mujoco.MjData(model), Simulator(scene)

    def at(q: Array, v: Array, u: Array) -> Array:
        data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, u[: model.nu]
        mujoco.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        return full

    for _ in range(3):
        q = model.qpos0.copy()
        mujoco.mj_integratePos(model, q, rng.normal(size=model.nv) * 0.3, 1.0)
        v, u = rng.normal(size=model.nv), rng.normal(size=scene.nu) * 10
        full = at(q, v, u)
        sim.q[0], sim.v[0] = q, v
        np.testing.assert_allclose(sim.mass_matrix()[0], full, atol=1e-10)
        np.testing.assert_allclose(sim.bias()[0], data.qfrc_bias, rtol=1e-9, atol=1e-9)

    motors = [a for a in scene.actuators if model.nu == 0]  # of a URDF file: u is the joint force
    earlier: Array | None = None  # BDF2 starts with a step of BDF1
    for step in range(steps):
        before, u = sim.v[0].copy(), rng.normal(size=scene.nu) * (10 if step % 4 == 0 else 0.5)
        sim.step(u)
        sim.check()
        q, v = sim.q[0].copy(), sim.v[0].copy()
        full = at(q, v, u)
        force = data.qfrc_passive + data.qfrc_actuator - data.qfrc_bias
        force -= model.dof_frictionloss * np.clip(v / 1e-3, -1, 1)
        for motor, control in zip(motors, u, strict=bool(motors)):
            force[scene.joints[motor.joint].v_start] += np.clip(control, *motor.force_range)
        if scene.integrator == "bdf1" or earlier is None:
            inertia = full @ (v - before) / scene.step
        else:
            inertia = full @ (3 * v - 4 * before + earlier) / (2 * scene.step)
        earlier = before
        np.testing.assert_allclose(inertia, force, rtol=1e-6, atol=1e-6 * np.abs(force).max())
    assert sim.halved[0] == 0


def test_arm_with_classes_meshes_and_servos(tmp_path: Path) -> None:
    write(tmp_path, ARM)
    write_stl(tmp_path / "assets" / "link.stl")
    scene = load(tmp_path)
    assert [a.kind for a in scene.actuators] == ["position"] * 6
    assert [(a.kp, a.kd) for a in scene.actuators[:3]] == [(2000, 400)] * 3
    assert scene.actuators[3].kd > 0 and scene.actuators[3].ctrl_range == (-6.2831, 6.2831)
    assert [a.name for a in scene.actuators][-1] == "actuator5"  # generated
    assert scene.q0[0] == -1.5708  # the keyframe "home"
    assert any("exclude" in line for line in scene.not_modelled)
    assert any(line.startswith("mesh geom") for line in scene.not_modelled)
    check_against_mujoco(scene, mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml")))


def test_rover_with_velocity_servos_and_ball_joint(tmp_path: Path) -> None:
    scene = load(write(tmp_path, ROVER))
    assert [(a.kind, a.kd, a.gear) for a in scene.actuators] == [("velocity", 2, 5)] * 2
    assert [j.type for j in scene.joints] == ["free", "hinge", "hinge", "ball", "hinge", "slide"]
    assert (scene.nq, scene.nv) == (7 + 2 + 4 + 2, 6 + 2 + 3 + 2)
    assert scene.q("caster") == slice(9, 13) and scene.v("caster") == slice(8, 11)
    assert scene.joints[4].ref == pytest.approx(np.radians(30))
    np.testing.assert_allclose(Simulator(scene).q[0], scene.q0)
    check_against_mujoco(scene, mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml")))


def urdf(folder: Path, more: str = "") -> Scene:
    write_stl(folder / "my_arm" / "meshes" / "link.stl")
    write(folder / "my_arm", {"urdf/arm.urdf": URDF.replace("</robot>", f"{more}</robot>")})
    return load(folder, "my_arm/urdf/arm.urdf")


def test_urdf_arm_with_a_package_mesh(tmp_path: Path) -> None:
    scene = urdf(tmp_path)
    assert [b.name for b in scene.bodies] == ["upper", "lower", "slider"]
    assert [(j.name, j.type, j.frictionloss) for j in scene.joints] == [
        ("turn", "hinge", 0.2),
        ("lift", "hinge", 0),
        ("slide", "slide", 0),
    ]
    assert [(a.name, a.kind, a.force_range) for a in scene.actuators] == [
        ("turn", "motor", (-10, 10)),
        ("lift", "motor", (-5, 5)),
        ("slide", "motor", (-np.inf, np.inf)),
    ]
    absolute = tmp_path / "absolute.urdf"  # MuJoCo does not resolve package:// addresses
    absolute.write_text(URDF.replace("package://my_arm/meshes/link.stl", str(tmp_path / "my_arm/meshes/link.stl")))
    check_against_mujoco(scene, mujoco.MjModel.from_xml_path(str(absolute)))


@pytest.mark.parametrize(
    ("more", "actuators"),
    [(TRANSMISSION, ["lift_motor"]), (CONTROL, ["turn"]), (TRANSMISSION + CONTROL, ["turn", "lift_motor"])],
)
def test_urdf_transmissions_select_the_actuated_joints(more: str, actuators: list[str], tmp_path: Path) -> None:
    scene = urdf(tmp_path, more)
    assert [a.name for a in scene.actuators] == actuators
    assert all(a.gear == 1 for a in scene.actuators)


def test_pad_on_a_urdf_link(tmp_path: Path) -> None:
    urdf(tmp_path)
    more = (
        '[pads.p]\nsite = "tcp"\nrows = 2\ncols = 2\npitch = 1e-3\nagainst = "geom1"\nkn = 1\nkt = 1\nmu = 1\nkd = 1\n'
    )
    scene = load(tmp_path, "my_arm/urdf/arm.urdf", more)
    assert scene.bodies[scene.pads[0].body].name == "slider"
    np.testing.assert_allclose(scene.pads[0].positions.mean(0), [0, 0, 0.2], atol=1e-12)


JOINT = """<mujoco><compiler angle="radian"/><worldbody>
  <body><joint name="j" axis="0 1 0" {joint}/><geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3"/></body>
  </worldbody><actuator>{actuators}</actuator></mujoco>"""

ACTUATORS = [  # (attributes of the joint, actuators, kinds)
    ("", '<motor joint="j" gear="-3" ctrlrange="-1 2" ctrllimited="true"/>', ["motor"]),
    ("", '<general joint="j" gainprm="4" gear="2" forcerange="-3 3" forcelimited="true"/>', ["general"]),
    ("", '<position joint="j" kp="30" kv="2" gear="1.5"/>', ["position"]),
    ("", '<position joint="j" kp="30" dampratio="0.7" forcerange="-1 1"/>', ["position"]),
    ("", '<velocity joint="j" kv="3" gear="-2" ctrlrange="-1 1"/>', ["velocity"]),
    ("", '<general joint="j" biastype="affine" gainprm="2" biasprm="0.5 -7 -0.3" gear="1.2"/>', ["general"]),
    ("", '<general joint="j" biastype="affine" gainprm="0" biasprm="0 -7 -0.3"/>', ["general"]),
    ("", '<general joint="j" gaintype="affine" gainprm="2 0 0"/>', ["general"]),
    ("", '<motor jointinparent="j"/>', ["motor"]),
    ("", '<motor joint="j"/><position joint="j" kp="5"/>', ["motor", "position"]),
    ('actuatorfrcrange="-2 1"', '<motor joint="j" gear="-4"/>', ["motor"]),
    ('actuatorfrcrange="-2 1"', '<position joint="j" kp="50" gear="3" forcerange="-0.5 9"/>', ["position"]),
    ('actuatorfrcrange="-2 1"', "", []),
    (
        'damping="0.2" armature="0.1"',
        '<position joint="j" kp="5" gear="3" armature="0.2" damping="0.1"/>',
        ["position"],
    ),
    ('stiffness="3" springref="0.4" ref="0.3" springdamper="0 0"', '<motor joint="j"/>', ["motor"]),
    ('springdamper="0.3 1" frictionloss="0.2"', '<motor joint="j"/>', ["motor"]),
]


@pytest.mark.parametrize(("joint", "actuators", "kinds"), ACTUATORS, ids=[f"{j} {a}".strip() for j, a, _ in ACTUATORS])
def test_joints_and_actuators_agree_with_mujoco(joint: str, actuators: str, kinds: list[str], tmp_path: Path) -> None:
    write(tmp_path, {"scene.xml": JOINT.format(joint=joint, actuators=actuators)})
    scene = load(tmp_path)
    assert [a.kind for a in scene.actuators] == kinds
    check_against_mujoco(scene, mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml")))


FLAGS = ["gravity", "spring", "damper", "frictionloss", "clampctrl"]


@pytest.mark.parametrize("flag", FLAGS)
def test_disable_flags_are_applied(flag: str, tmp_path: Path) -> None:
    text = JOINT.format(
        joint='stiffness="3" damping="0.3" frictionloss="0.4"', actuators='<motor joint="j" ctrlrange="-1 1"/>'
    ).replace("<worldbody>", f'<option><flag {flag}="disable"/></option><worldbody>')
    scene = load(write(tmp_path, {"scene.xml": text}))
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    if flag == "frictionloss":
        model.dof_frictionloss[:] = 0
    check_against_mujoco(scene, model)


def test_elements_without_effect_are_not_modelled(tmp_path: Path) -> None:
    text = JOINT.format(joint="", actuators="").replace(
        "<actuator>",
        '<tendon><spatial name="t"><site site="a"/><site site="b"/></spatial></tendon>'
        '<equality><joint joint1="j" active="false"/></equality><actuator>',
    )
    text = text.replace("<worldbody>", '<worldbody><site name="a"/><site name="b" pos="0 0 1"/>')
    scene = load(write(tmp_path, {"scene.xml": text}))
    assert [line.split(":")[0] for line in scene.not_modelled[:2]] == ["1 spatial tendons", "1 equality constraints"]


LIMITS = [  # (attributes of the joint, actuator, expected stiffness without the lower bound by the inertia)
    ("", '<motor joint="j" gear="2" forcerange="-3 1"/>', 2 * 3 / 0.01),
    ("", '<motor joint="j" gear="2" ctrlrange="-3 5"/>', 2 * 5 / 0.01),
    ('actuatorfrcrange="-50 50"', '<position joint="j" kp="70" kv="2"/>', 50 / 0.01),
    ("", '<position joint="j" kp="70" gear="2"/>', 100 * 4 * 70),
    ("", '<motor joint="j"/>', 0),
    ("", "", 0),
]


@pytest.mark.parametrize(("joint", "actuators", "stiffness"), LIMITS)
def test_default_joint_limits(joint: str, actuators: str, stiffness: float, tmp_path: Path) -> None:
    write(tmp_path, {"scene.xml": JOINT.format(joint=f'range="-0.5 0.5" {joint}', actuators=actuators)})
    scene = load(tmp_path)
    inertia = Simulator(scene).mass_matrix()[0, 0, 0]
    limit = scene.limits[0]
    assert limit.stiffness == pytest.approx(max(stiffness, inertia / 0.01**2))
    assert limit.damping == pytest.approx(2 * (limit.stiffness * inertia) ** 0.5)
    custom = load(tmp_path, more="[joints.j]\nlimit_stiffness = 7\n").limits[0]
    assert (custom.stiffness, custom.damping) == (7, 0)
    custom = load(tmp_path, more="[joints.j]\nlimit_damping = 7\n").limits[0]
    assert (custom.stiffness, custom.damping) == (limit.stiffness, 7)


def test_full_motor_force_deflects_the_default_limit_by_10_mrad(tmp_path: Path) -> None:
    text = JOINT.format(joint='range="-0.5 0.5"', actuators='<motor joint="j" forcerange="-20 20"/>')
    scene = load(write(tmp_path, {"scene.xml": text.replace("<worldbody>", '<option gravity="0 0 0"/><worldbody>')}))
    sim = Simulator(scene)
    sim.step(np.array([1e3]), 1000)
    sim.check()
    assert sim.q[0, 0] == pytest.approx(0.51, abs=1e-6)


def test_changed_mesh_is_read_again_at_once(tmp_path: Path) -> None:
    write_stl(tmp_path / "large.stl")
    body = '<body><joint/><geom type="mesh" mesh="m"/></body>'
    (tmp_path / "robot.xml").write_text(
        f'<mujoco><asset><mesh name="m" file="m.stl"/></asset><worldbody>{body}</worldbody></mujoco>'
    )
    data = (tmp_path / "large.stl").read_bytes()
    (tmp_path / "m.stl").write_bytes(data)
    large = load_scene(tmp_path / "robot.xml").bodies[0].mass
    halved = bytearray(data)
    for face in range((len(data) - 84) // 50):
        vertices = slice(84 + 50 * face + 12, 84 + 50 * face + 48)
        halved[vertices] = (np.frombuffer(data[vertices], "<f4") / 2).tobytes()
    (tmp_path / "m.stl").write_bytes(halved)
    assert load_scene(tmp_path / "robot.xml").bodies[0].mass == pytest.approx(large / 8)
