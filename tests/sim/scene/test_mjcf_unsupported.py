"""Unsupported elements of model files give a one-line error with the element and advice."""

import re
from pathlib import Path

import pytest

from gelflow.errors import UsageError
from gelflow.sim.scene import load_scene

MODEL = """<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body name="arm">
      <joint name="swing" axis="0 1 0"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3"/>
      <site name="tip" pos="0 0 -0.3"/>
    </body>
    <site name="anchor" pos="0 0 1"/>
    <body name="ball" pos="1 0 0"><joint name="socket" type="ball"/><geom name="ball" size="0.1"/></body>
    <body name="block" pos="2 0 0"><freejoint name="floating"/><geom size="0.1"/></body>
  </worldbody>
  <actuator><motor name="push" joint="swing"/></actuator>
</mujoco>"""

MOTOR = '<motor name="push" joint="swing"/>'
SERVO = "use motor, position, velocity or general on joints"
TENDON = '<tendon><fixed name="split" {}><joint joint="swing" coef="0.5"/></fixed></tendon>'
ROPE = '<tendon><spatial name="rope" {}><site site="tip"/><site site="anchor"/></spatial></tendon>'


def actuator(text: str) -> tuple[str, str]:
    return MOTOR, text


def section(text: str) -> tuple[str, str]:
    return "</worldbody>", f"</worldbody>{text}"


def swing(text: str) -> tuple[str, str]:
    return 'axis="0 1 0"', f'axis="0 1 0" {text}'


def option(text: str) -> tuple[str, str]:
    return "<worldbody>", f"<option {text}<worldbody>"


UNSUPPORTED = [
    (
        section(ROPE.format('stiffness="3"')),
        "spatial tendon 'rope' is not supported: remove it or drive the joints directly",
    ),
    (
        section(ROPE.format('limited="true" range="0 1"')),
        "spatial tendon 'rope' is not supported: remove it or drive the joints directly",
    ),
    (
        section(ROPE.format("") + '<actuator><position tendon="rope"/></actuator>'),
        "spatial tendon 'rope' is not supported: remove it or drive the joints directly "
        "(also not supported: actuator 'actuator0' on a spatial tendon)",
    ),
    (
        section(TENDON.format('stiffness="3" springlength="0 1"')),
        "range of springlength of tendon 'split' is not supported: give one length",
    ),
    (
        section(TENDON.format('stiffness="3 1"')),
        "polynomial stiffness or damping of tendon 'split' is not supported: give one coefficient",
    ),
    (
        section(ROPE.format("") + '<equality><tendon tendon1="rope"/></equality>'),
        "equality tendon of 'rope' is not supported: remove it, or make it inactive",
    ),
    (
        (
            "</worldbody>",
            '<body name="cloth"><flexcomp name="cloth" type="grid" count="3 3 1" spacing="0.1 0.1 0.1" mass="1" '
            'radius="0.01" dim="2"><edge equality="true"/></flexcomp></body></worldbody>',
        ),
        "flex 'cloth' is not supported: remove it",
    ),
    (
        section(
            '<extension><plugin plugin="mujoco.pid"><instance name="pid"/></plugin></extension>'
            '<actuator><plugin name="servo" joint="swing" plugin="mujoco.pid" instance="pid"/></actuator>'
        ),
        f"actuator 'servo' with a plugin is not supported: {SERVO}",
    ),
    (option('density="1"/>'), "option density is not supported: remove it; fluid forces are not simulated"),
    (option('viscosity="1"/>'), "option viscosity is not supported: remove it; fluid forces are not simulated"),
    (option('wind="1 0 0"/>'), "option wind is not supported: remove it; fluid forces are not simulated"),
    (
        option('><flag actuation="disable"/></option>'),
        'flag actuation="disable" is not supported: remove it; for motors, controls of 0 have the same effect',
    ),
    (
        option('actuatorgroupdisable="2"/>'),
        "option actuatorgroupdisable is not supported: remove it, and the actuators",
    ),
    (
        ('type="ball"', 'type="ball" range="0 60"'),
        "range of ball joint 'socket' is not supported: remove it, or replace the joint by three hinges",
    ),
    (('type="ball"', 'type="ball" stiffness="2"'), "stiffness of ball joint 'socket' is not supported: remove it"),
    (
        ('<freejoint name="floating"/>', '<joint name="floating" type="free" stiffness="2"/>'),
        "stiffness of free joint 'floating' is not supported: remove it",
    ),
    (swing('stiffness="1 2"'), "polynomial stiffness of joint 'swing' is not supported: give one coefficient"),
    (swing('frictionloss="-1"'), "negative frictionloss of joint 'swing' is not supported: give 0 or more"),
    (section(TENDON.format('damping="-1"')), "negative damping of tendon 'split' is not supported: give 0 or more"),
    (swing('damping="1 2"'), "polynomial damping of joint 'swing' is not supported: give one coefficient"),
    (
        actuator('<motor joint="socket"/>'),
        "actuator 'actuator0' on ball joint 'socket' is not supported: drive slide or hinge joints",
    ),
    (actuator('<motor joint="floating"/>'), "actuator 'actuator0' on free joint 'floating' is not supported: drive"),
    (
        actuator('<motor name="jet" site="tip"/>'),
        "actuator 'jet' on a site is not supported: drive the joints directly",
    ),
    (
        actuator('<motor name="crank" cranksite="tip" slidersite="tip" cranklength="1"/>'),
        "actuator 'crank' on a slider-crank is not supported: drive the joints directly",
    ),
    (actuator('<adhesion name="cup" body="arm" ctrlrange="0 1"/>'), "actuator 'cup' on a body (adhesion) is not"),
    (
        actuator('<muscle name="biceps" joint="swing" lengthrange="0 1"/>'),
        f"actuator 'biceps' with gaintype muscle is not supported: {SERVO}",
    ),
    (
        actuator('<damper name="brake" joint="swing" kv="2" ctrlrange="0 1"/>'),
        f"actuator 'brake' with gaintype affine is not supported: {SERVO}",
    ),
    (
        actuator('<dcmotor name="dc" joint="swing" motorconst="0.1" resistance="1"/>'),
        f"actuator 'dc' with gaintype dcmotor is not supported: {SERVO}",
    ),
    (
        actuator('<position name="slow" joint="swing" timeconst="0.1"/>'),
        "actuator 'slow' with an activation (dyntype filterexact) is not supported: remove timeconst or dyntype",
    ),
    (
        actuator('<intvelocity name="int" joint="swing" kp="2" actrange="-1 1"/>'),
        "actuator 'int' with an activation (dyntype integrator) is not supported: remove timeconst or dyntype",
    ),
    (
        actuator('<cylinder name="air" joint="swing" timeconst="1"/>'),
        "actuator 'air' with an activation (dyntype filter) is not supported: remove timeconst or dyntype",
    ),
    (
        actuator('<motor name="late" joint="swing" delay="0.1" nsample="3"/>'),
        "actuator 'late' with a delay is not supported: remove it",
    ),
    (
        actuator('<motor name="push" joint="swing" damping="1 2"/>'),
        "polynomial damping of actuator 'push' is not supported: give one coefficient",
    ),
    (
        section('<asset><mesh name="shell" file="meshes/gone.stl"/></asset>'),
        "mesh 'shell': no file meshes/gone.stl (searched at ",
    ),
    (section('<asset><mesh file="robot.toml"/></asset>'), "mesh 'robot': robot.toml has an unsupported format; "),
    (section('<asset><texture name="wood" type="2d" file="gone.png"/></asset>'), "gone.png"),
    (section('<include file="gone.xml"/>'), "Error opening file"),
    (('name="ball" pos', 'name="arm" pos'), "repeated name 'arm' in body"),
    (("</mujoco>", ""), "XML"),
]


@pytest.mark.parametrize(("change", "message"), UNSUPPORTED, ids=[message for _, message in UNSUPPORTED])
def test_unsupported_element_is_an_error(change: tuple[str, str], message: str, tmp_path: Path) -> None:
    old, new = change
    assert old in MODEL
    (tmp_path / "robot.xml").write_text(MODEL.replace(old, new, 1))
    check_error(tmp_path, "robot.xml", message)


def check_error(folder: Path, model: str, message: str, more: str = "") -> None:
    (folder / "robot.toml").write_text(f'format = 1\nmodel = "{model}"\nstep = 0.002\n{more}')
    with pytest.raises(UsageError) as caught:
        load_scene(folder / "robot.toml")
    text = str(caught.value)
    assert model in text or more
    assert message in text
    assert "\n" not in text


def test_unchanged_model_is_supported(tmp_path: Path) -> None:
    (tmp_path / "robot.xml").write_text(MODEL)
    (tmp_path / "robot.toml").write_text('format = 1\nmodel = "robot.xml"\nstep = 0.002\n')
    scene = load_scene(tmp_path / "robot.toml")
    assert [j.type for j in scene.joints] == ["hinge", "ball", "free"]


def test_joint_force_range_with_several_actuators_is_an_error(tmp_path: Path) -> None:
    limited = MODEL.replace('axis="0 1 0"', 'axis="0 1 0" actuatorfrcrange="1 2"')
    (tmp_path / "robot.xml").write_text(limited.replace(MOTOR, MOTOR + '<position joint="swing"/>'))
    check_error(
        tmp_path,
        "robot.xml",
        "actuatorfrcrange of joint 'swing' with 2 actuators is not supported: give each actuator a forcerange",
    )
    (tmp_path / "robot.xml").write_text(
        limited.replace(MOTOR, '<motor name="push" joint="swing" forcerange="-1 0.5"/>')
    )
    check_error(
        tmp_path, "robot.xml", "actuator 'push': forcerange and the actuatorfrcrange that it acts on are disjoint"
    )


TENDON = """<tendon><fixed name="t" {}><joint joint="swing" coef="2"/></fixed></tendon>
  <actuator><motor tendon="t"/>{}</actuator>"""


@pytest.mark.parametrize(
    ("joint", "tendon", "actuator", "message"),
    [
        ("", 'actuatorfrcrange="-1 2"', '<motor tendon="t"/>', "actuatorfrcrange of tendon 't' with 2 actuators"),
        ('actuatorfrcrange="1 2"', "", "", "actuatorfrcrange of joint 'swing', which a tendon drives"),
    ],
)
def test_force_range_of_several_actuators_on_a_tendon_is_an_error(
    joint: str, tendon: str, actuator: str, message: str, tmp_path: Path
) -> None:
    model = MODEL.replace('axis="0 1 0"', f'axis="0 1 0" {joint}')
    (tmp_path / "robot.xml").write_text(model.replace("</mujoco>", TENDON.format(tendon, actuator) + "</mujoco>"))
    check_error(tmp_path, "robot.xml", message)


LINK = """<link name="{}"><inertial><mass value="1"/>
  <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>{}</link>"""
URDF = f"""<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro"><link name="base"/>
  {LINK.format("upper", '<collision><geometry><mesh filename="FILE"/></geometry></collision>')}
  {LINK.format("lower", "")}
  <joint name="a" type="continuous"><parent link="base"/><child link="upper"/></joint>
  <joint name="b" type="continuous"><parent link="upper"/><child link="lower"/></joint></robot>"""

UNSUPPORTED_URDF = [
    (
        ("</joint></robot>", '<mimic joint="c" multiplier="2"/></joint></robot>'),
        "joint 'b' mimics 'c', which the file does not have",
    ),
    (
        ("</joint></robot>", '<mimic joint="a" multiplier="twice"/></joint></robot>'),
        "joint 'b': multiplier and offset of <mimic> must be numbers",
    ),
    (("<link", '<xacro:include filename="macros.xacro"/><link'), "has xacro macros, which are not expanded; run xacro"),
    (("FILE", "package://my_arm/link.stl"), "mesh 'link': no file package://my_arm/link.stl (searched at "),
    (("FILE", "robot.toml"), "mesh 'robot': robot.toml has an unsupported format; convert it to .stl or .obj"),
    (("</robot>", ""), "XML"),
]


@pytest.mark.parametrize(("change", "message"), UNSUPPORTED_URDF, ids=[message for _, message in UNSUPPORTED_URDF])
def test_unsupported_urdf_is_an_error(change: tuple[str, str], message: str, tmp_path: Path) -> None:
    old, new = change
    assert old in URDF
    (tmp_path / "arm.urdf").write_text(URDF.replace(old, new, 1))
    check_error(tmp_path, "arm.urdf", message)


def test_sampled_mesh_needs_a_count(tmp_path: Path) -> None:
    mesh = '<asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset><worldbody>'
    text = MODEL.replace("<worldbody>", mesh).replace('name="ball" size="0.1"', 'name="ball" type="mesh" mesh="m"')
    (tmp_path / "robot.xml").write_text(text)
    check_error(tmp_path, "robot.xml", "points.p: count is missing", '[points.p]\ngeom = "ball"\n')


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (option('gravity="0 0 nan"/>'), "parameter 'gravity.z' must be a number, got nan"),
        (swing('damping="nan"'), "parameter 'swing.damping' must be a number, got nan"),
        (swing('stiffness="inf"'), "parameter 'swing.stiffness' must be finite, got inf"),
        (swing('springref="nan" stiffness="1"'), "parameter 'swing.springref' must be a number, got nan"),
        (
            actuator('<motor name="push" joint="swing" gear="nan"/>'),
            "an actuator's gear has an entry that is not finite",
        ),
        (
            ('name="ball" size="0.1"', 'name="ball" size="0.1" mass="inf"'),
            "a body's mass has an entry that is not finite",
        ),
        (
            section('<tendon><fixed name="t" stiffness="nan"><joint joint="swing" coef="1"/></fixed></tendon>'),
            "parameter 't.stiffness' must be a number, got nan",
        ),
    ],
)
def test_a_number_that_is_not_finite_is_an_error(change: tuple[str, str], message: str, tmp_path: Path) -> None:
    (tmp_path / "robot.xml").write_text(MODEL.replace(*change, 1))
    with pytest.raises(UsageError, match=rf"robot\.xml: {re.escape(message)}") as caught:
        load_scene(tmp_path / "robot.xml").build()
    assert "\n" not in str(caught.value)
