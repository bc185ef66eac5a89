"""Grippers with coupled joints and closed loops close on three objects and lift them; the slip has exact gradients."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from gelflow.errors import UsageError
from gelflow.sim import _core
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation import reference_meshes

STEP = 2e-3
HEIGHT = 0.1  # of the hand above the middle of the object [m]


@dataclass(frozen=True)
class Gripper:
    """A gripper with the fingers `left` at −x and `right` at +x of a body that is lifted."""

    bodies: str  # MJCF, of the two fingers
    couplings: str  # MJCF, beside the worldbody
    tip: tuple[float, float, float]  # middle of the pad in the frame of a finger, which faces +x [m]
    grip: tuple[float, float]  # control that holds the object, and that lets it slip
    pad: str = "rows = 7\ncols = 7\npitch = 3e-3"


def both_sides(finger: str) -> str:
    """The finger at −x, and turned about z by half a turn at +x."""
    return "".join(
        f'<body name="{side}_base" quat="{quat}"><inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>'
        f"{finger.replace('SIDE', side)}</body>"
        for side, quat in (("left", "1 0 0 0"), ("right", "0 0 0 1"))
    )


MASS = '<inertial pos="0 0 0" mass="0.02" diaginertia="1e-5 1e-5 1e-5"/>'
HALVES = '<joint joint="left" coef="0.5"/><joint joint="right" coef="0.5"/>'
EQUAL = '<equality>MORE<joint joint1="right" joint2="left"/></equality>'
PARALLEL = Gripper(
    both_sides(
        f'<body name="SIDE_finger" pos="-0.022 0 -0.1"><joint name="SIDE" type="slide" axis="1 0 0"/>{MASS}</body>'
    ),
    f'<tendon><fixed name="split">{HALVES}</fixed></tendon>{EQUAL.replace("MORE", "")}'
    '<actuator><motor name="grip" tendon="split"/></actuator>',
    (0, 0, 0),
    (10, 0.75),
)
# Each finger is the coupler of a parallelogram, so that its pad stays vertical.
FOUR_BAR = Gripper(
    both_sides(
        f'<body name="SIDE_crank" pos="-0.03 0 0"><joint name="SIDE" axis="0 -1 0"/>{MASS}'
        f'<body name="SIDE_finger" pos="0 0 -0.06"><joint name="SIDE_coupler" axis="0 -1 0"/>{MASS}</body></body>'
        f'<body name="SIDE_rocker" pos="-0.03 0 -0.02"><joint name="SIDE_rocker" axis="0 -1 0"/>{MASS}</body>'
    ),
    "".join(
        ["<equality>"]
        + [f'<connect body1="{side}_rocker" body2="{side}_finger" anchor="0 0 -0.06"/>' for side in ("left", "right")]
        + ['<joint joint1="right" joint2="left"/></equality><actuator><motor name="grip" joint="left"/></actuator>']
    ),
    (0, 0, -0.04),
    (0.6, 0.055),
)
# A tendon bends both joints of a finger; a spring keeps the outer one straight.
TENDON = Gripper(
    both_sides(
        f'<body name="SIDE_inner" pos="-0.032 0 0"><joint name="SIDE" axis="0 -1 0" damping="0.01"/>{MASS}'
        '<body name="SIDE_finger" pos="0 0 -0.05">'
        f'<joint name="SIDE_outer" axis="0 -1 0" stiffness="0.5" damping="0.01"/>{MASS}</body></body>'
    ),
    "<tendon>"
    + "".join(
        f'<fixed name="{side}_tendon"><joint joint="{side}" coef="1"/><joint joint="{side}_outer" coef="0.6"/></fixed>'
        for side in ("left", "right")
    )
    + '</tendon><equality><joint joint1="right" joint2="left"/></equality>'
    + '<actuator><motor name="grip" tendon="left_tendon"/><motor name="grip_right" tendon="right_tendon"/></actuator>',
    (0, 0, -0.05),
    (0.5, 0.045),
    'shape = "hemisphere"\nradius = 0.01\ncount = 60',
)
GRIPPERS = {"tendon and equality": PARALLEL, "four-bar": FOUR_BAR, "tendons of two joints": TENDON}
OBJECTS = {
    "cube": 'type="box" size="0.02 0.02 0.02"',
    "cylinder": 'type="cylinder" size="0.02 0.02"',
    "mesh": 'type="mesh" mesh="object"',
}


def gripper_scene(folder: Path, gripper: Gripper, solid: str, mu: float) -> Path:
    angles = np.radians(30 + 60 * np.arange(12))
    prism = (
        np.column_stack([np.cos(angles), np.sin(angles), np.repeat([-0.87, 0.87], 6)]) * 0.0231
    )  # 40 mm across flats
    (folder / "object.obj").write_text(reference_meshes.obj(reference_meshes.hull(prism)))
    (folder / "lift.xml").write_text(
        f"""<mujoco><asset><mesh name="object" file="object.obj"/></asset>
  <worldbody>
    <geom name="table" type="box" size="0.03 0.03 0.01" pos="0 0 -0.01"/>
    <body name="hand" pos="0 0 {HEIGHT + 0.02}">
      <joint name="lift" type="slide" axis="0 0 1"/>{MASS}{gripper.bodies}
    </body>
    <body name="object" pos="0 0 0.02">
      <freejoint name="object"/><geom name="object" mass="0.05" {OBJECTS[solid]}/>
    </body>
  </worldbody>
  {gripper.couplings.replace("<actuator>", '<actuator><position name="lift" joint="lift" kp="2e4" kv="400"/>')}
</mujoco>"""
    )
    law = f"against = 'object'\ncollides = true\nkn = 500\nkt = 2\nks = 250\nmu = {mu}\nkd = 20\n"
    (folder / "lift.toml").write_text(
        'format = 1\nmodel = "lift.xml"\nfriction = "elastic"\n'
        f"step = {STEP}\ntolerance = 1e-11\n"
        + "".join(
            f'[sites.{side}_tip]\nbody = "{side}_finger"\npos = {list(gripper.tip)}\n'
            "z_axis = [1, 0, 0]\nx_axis = [0, 0, -1]\n"
            f"[pads.{side}_pad]\nsite = '{side}_tip'\n{gripper.pad}\n{law}"
            for side in ("left", "right")
        )
        + '[points.object]\ngeom = "object"\n'
        + {"cube": "resolution = [3, 3, 2]", "cylinder": "", "mesh": "count = 200"}[solid]
        + '\n[contacts.table]\npoints = "object"\nagainst = "table"\nkn = 2000\nkt = 2\nks = 1000\nmu = 0.5\nkd = 50\n'
    )
    return folder / "lift.toml"


def held(folder: Path, gripper: Gripper, solid: str, mu: float = 0.8, integrator: str = "bdf2") -> Simulator:
    """The object rests on the table between the closed fingers."""
    scene = load_scene(gripper_scene(folder, gripper, solid, mu), overrides={"integrator": integrator})
    sim = Simulator(scene)
    for _ in range(200):
        sim.step(controls(sim, gripper.grip[0]))
    assert sim.status[0] == 0
    assert sim.tactile()[0].reshape(2, -1, 3)[..., 2].sum(1) == pytest.approx(
        0.5 * sim.tactile()[0, :, 2].sum(), rel=0.05
    )
    return sim


def controls(sim: Simulator, grip: float, lift: float = 0.0) -> np.ndarray:
    u = np.zeros((1, sim.model.nu))
    u[0, 1:] = grip
    u[0, 0] = lift
    return u


@pytest.mark.parametrize("solid", OBJECTS)
@pytest.mark.parametrize("name", GRIPPERS)
def test_gripper_lifts_an_object(name: str, solid: str, tmp_path: Path) -> None:
    sim = held(tmp_path, GRIPPERS[name], solid)
    lifted, object_z = sim.joint_q("lift"), sim.joint_q("object") + 2
    start = sim.q[0, [lifted, object_z]]
    for s in np.linspace(0, 1, 150):
        sim.step(controls(sim, GRIPPERS[name].grip[0], 0.05 * s**3 * (10 - 15 * s + 6 * s**2)))
    for _ in range(100):
        sim.step(controls(sim, GRIPPERS[name].grip[0], 0.05))
    hand, thing = sim.q[0, [lifted, object_z]] - start
    assert sim.status[0] == 0
    assert hand == pytest.approx(0.05, abs=1e-4)
    assert thing == pytest.approx(hand, abs=5e-4)


@pytest.mark.parametrize("integrator", ["bdf1", "bdf2"])
@pytest.mark.parametrize("solid", OBJECTS)
@pytest.mark.parametrize("name", GRIPPERS)
def test_slip_by_grip_force(name: str, solid: str, integrator: str, tmp_path: Path) -> None:
    """The hand rises and the grip is too weak: the derivative of the slip by the grip is exact.

    The grip weakens slowly, so that the fingers keep contact. Fingers that are released at once fly off and return;
    the slip is then not differentiable at grip forces that differ by 1e-6 of their value, where points of the pads
    touch one step earlier or later, and differences across such kinks are no derivatives.
    """
    gripper = GRIPPERS[name]
    sim = held(tmp_path, gripper, solid, integrator=integrator)
    for grip in np.linspace(*gripper.grip, 100):
        sim.step(controls(sim, grip))
    lift, thing = sim.joint_q("lift"), sim.joint_q("object") + 2
    u = np.concatenate([controls(sim, gripper.grip[1], 0.02 * s) for s in np.linspace(0, 1, 60)])
    by_grip = np.zeros_like(u)
    by_grip[:, 1:] = gripper.grip[1]  # by the logarithm of the force
    start = {key: getattr(sim, key)[0].copy() for key in ("params", "q", "v", "anchors", "anchored", "history")}

    trajectory = sim.rollout(u[:, None])
    slip = trajectory.q[:, 0, lift] - trajectory.q[:, 0, thing]
    assert trajectory.status[0] == 0 and slip[-1] - slip[0] > 1e-3 and sim.tactile().any()
    by_q = np.zeros_like(trajectory.q)
    by_q[-1, 0, [lift, thing]] = 1, -1
    gradient = float((sim.rollout_gradient(trajectory, q=by_q).u[:, 0] * by_grip).sum())

    still = {key: np.zeros_like(value) for key, value in start.items() if key not in ("q", "anchored")}
    along = _core.RolloutInput(q=np.zeros(sim.model.nv), u=by_grip, **still)
    moved = _core.directional_rollout(sim.model, _core.RolloutInput(u=u, **start), [along]).derivatives[0].q
    assert moved[sim.joint_v("lift")] - moved[sim.joint_v("object") + 2] == pytest.approx(gradient, rel=1e-9)

    def difference(size: float) -> float:
        ends = [sim.rollout((u + sign * size * by_grip)[:, None]).q[-1, 0, [lift, thing]] for sign in (1, -1)]
        return float((ends[0][0] - ends[0][1] - ends[1][0] + ends[1][1]) / (2 * size))

    assert (4 * difference(1e-5) - difference(2e-5)) / 3 == pytest.approx(gradient, rel=1e-6)


def test_site_of_a_scene_file(tmp_path: Path) -> None:
    path = gripper_scene(tmp_path, PARALLEL, "cube", 0.5)
    text = path.read_text()
    scene = load_scene(path)
    site = scene.sites[scene.site("left_tip")]
    assert scene.bodies[site.body].name == "left_finger"
    assert site.pose.matrix() == pytest.approx(np.column_stack([[0, 0, -1], [0, 1, 0], [1, 0, 0]]))
    for wrong, message in (
        ('body = "left_fingre"', r"lift.toml, sites.left_tip: no body 'left_fingre'; did you mean 'left_finger'"),
        ('body = "left_finger"\nzaxis = [1, 0, 0]', "unknown key 'zaxis'"),
    ):
        path.write_text(text.replace('body = "left_finger"', wrong))
        with pytest.raises(UsageError, match=message):
            load_scene(path)
    path.write_text(text.replace("x_axis = [0, 0, -1]", "x_axis = [2, 0, 0]"))
    with pytest.raises(UsageError, match="must not be zero or parallel"):
        load_scene(path)
    model = tmp_path / "lift.xml"
    model.write_text(model.read_text().replace("<freejoint", '<site name="left_tip"/><freejoint'))
    path.write_text(text)
    with pytest.raises(UsageError, match="the model has a site 'left_tip'"):
        load_scene(path)
