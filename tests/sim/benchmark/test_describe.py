"""`gelflow describe`: its tree and numbers compared with the scenes, and elements that are not modelled."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gelflow.cli.main import main
from gelflow.errors import UsageError
from gelflow.sim.benchmark.describe import describe
from gelflow.sim.benchmark.step_times import measure, with_duplicates
from gelflow.sim.scene import FRICTION_LAWS, load_scene, scene_names
from gelflow.sim.scene.start_controls import holding_controls
from gelflow.sim.simulator import Simulator

MODEL = """
<mujoco>
  <worldbody>
    <camera name="eye"/>
    <geom name="ground" type="plane" size="1 1 0.1"/>
    <body name="table"><geom name="top" type="box" size="0.1 0.1 0.01" pos="1 0 0"/></body>
    <body name="block" pos="0 0 0.02">
      <joint name="lift" type="slide" axis="0 0 1" damping="3" range="-1 1"/>
      <geom name="block" type="box" size="0.02 0.02 0.02"/>
      <body name="sticker">
        <geom name="sticker" type="box" size="0.01 0.01 0.01" mass="0"/>
        <site name="face" xyaxes="1 0 0 0 -1 0"/>
      </body>
    </body>
    <body name="other" pos="0.5 0 0.02">
      <joint name="turn" type="hinge" axis="0 1 0" frictionloss="0.1"/>
      <geom name="other" type="sphere" size="0.02"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="push" joint="lift" forcerange="-2 5"/>
    <position name="aim" joint="turn" kp="4" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""

SCENE = """
format = 1
model = "own.xml"
step = 5e-3
joints.lift = { limit_stiffness = 100.0 }
points.block = { geom = "block", resolution = [2, 3, 2], stiffness = "per area" }
contacts.stand = { points = "block", against = "ground", kn = 1e3, kt = 1.0, mu = 0.8, kd = 10.0 }
pads.pad = { site = "face", rows = 4, cols = 3, pitch = 1e-3, against = "ground", kn = 1.0, kt = 1.0, mu = 1, kd = 1 }
"""


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A small scene with one element of each kind that is not modelled."""
    (tmp_path / "own.xml").write_text(MODEL, encoding="utf-8")
    (tmp_path / "own.toml").write_text(SCENE, encoding="utf-8")
    return tmp_path / "own.toml"


def printed(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["describe", *arguments]) == 0
    return capsys.readouterr().out


def words(text: str) -> str:
    """The text without tree lines and line breaks."""
    return " ".join(text.translate(str.maketrans("│├└─┌┐┬┴┼┤", " " * 10)).split())


@pytest.mark.parametrize("law", FRICTION_LAWS)
@pytest.mark.parametrize("name", scene_names())
def test_tree_contains_every_part(name: str, law: str, capsys: pytest.CaptureFixture[str]) -> None:
    scene = load_scene(name, friction=law)
    lines = printed(capsys, name, "--friction", law, "--no-timing").splitlines()
    assert max(map(len, lines)) <= 80
    text = words("\n".join(lines))
    assert text.startswith(f"{name}: steps of 5 ms, {law} law")
    for joint in scene.joints:
        assert f"joint {joint.name}: {joint.type}" in text
    for actuator in scene.actuators:
        assert f"actuator {actuator.name}: {actuator.kind}" in text
    for body in scene.bodies:
        assert f" {body.name}: {body.mass:.4g} kg" in text or f" {body.name} on " in text
    points = {p.name: p for p in scene.points}
    for contact in scene.contacts:
        against = ", ".join(c.shape for c in scene.contacts if c.group == contact.group)
        sampled = points[contact.points]
        count = "one exact point" if sampled.radius > 0 else f"{len(sampled.points)} points"
        kind = next(g for g in ("box", "cylinder", "sphere") if f"{count} on {g} {sampled.geom}" in text)
        assert f"{contact.group}: {count} on {kind} {sampled.geom} against {against}" in text
    for pad in scene.pads:
        count = (
            f"{pad.grid.rows} × {pad.grid.cols} markers" if pad.grid else f"{len(pad.positions)} markers, a {pad.shape}"
        )
        assert f"{pad.name}: {count}" in text


def test_tree_shows_parameters_of_contacts_and_joints(capsys: pytest.CaptureFixture[str]) -> None:
    text = words(printed(capsys, "insertion", "--no-timing"))
    assert "range -0.055 to 0 m (stop 500 N/m), damping 20 N s/m" in text
    assert "actuator arm_yaw: position, k_p 10, k_d 0.1, force -100 to 100 N m" in text
    assert "elastic per point: k_n 8000 N/m, k_s 250 N/m, k_t 2.5 N s/m, k_d 1000 N s/m², µ 1.5" in text
    assert "elastic per point, linear damping: k_n 1000 N/m, k_s 500 N/m, k_t 1 N s/m, k_d 0.003 N s/m, µ 0.8" in text


@pytest.mark.parametrize("law", FRICTION_LAWS)
@pytest.mark.parametrize("name", scene_names())
def test_json_output_agrees_with_the_model(name: str, law: str, capsys: pytest.CaptureFixture[str]) -> None:
    description = json.loads(printed(capsys, name, "--friction", law, "--no-timing", "--json"))
    scene = load_scene(name, friction=law)
    sim = Simulator(scene)
    size = description["size"]
    for key in ("nq", "nv", "nu"):
        assert size[key] == getattr(sim.model, key) == getattr(scene, key)
    assert size["markers"] == sim.model.num_markers == scene.num_markers
    assert size["anchors"] == sim.model.na
    assert (size["anchors"] > 0) == (law == "elastic")
    assert size["parameters"] == len(sim.model.param_names)
    assert size["contact_pairs"] == len(sim.model.contact_names)
    assert size["candidate_points"] == sum(c["candidates"] * len(c["against"]) for c in description["contacts"])
    assert size["parameter_bytes"] == sim.params.nbytes
    assert size["reading_bytes"] == sim.tactile().nbytes
    assert size["state_bytes"] >= sum(a.nbytes for a in (sim.q, sim.v, sim.anchors, sim.anchored))
    joints = [joint for body in description["bodies"] for joint in body["joints"]]
    assert [joint["name"] for joint in joints] == list(sim.model.joint_names)
    actuators = [actuator["name"] for joint in joints for actuator in joint["actuators"]]
    assert sorted(actuators) == sorted(sim.model.actuator_names)
    assert [pad["name"] for pad in description["pads"]] == list(sim.model.pad_names)
    assert [pad["pitch_mm"] for pad in description["pads"]] == [pad.grid and pad.grid.pitch for pad in scene.pads]
    assert description["times"] is None


def test_memory_sizes_grow_with_anchors_and_markers() -> None:
    """The state stores every anchor and the model every marker; the workspace neither."""
    small, large = (
        describe(load_scene("pushing", friction="elastic", overrides={"pads.pad.rows": rows})).size
        for rows in (10, 1000)
    )
    more = 990 * 10
    assert large.anchors - small.anchors == large.markers - small.markers == more
    assert large.state_bytes - small.state_bytes == more * 25
    if large.model_bytes is not None and small.model_bytes is not None:
        assert large.model_bytes - small.model_bytes >= more * 24


def test_elements_that_are_not_modelled_are_listed(own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    description = describe(load_scene(own))
    world, block, other = description.bodies
    assert (world.merged, block.merged, other.merged) == (("table",), ("sticker",), ())
    assert block.geometry == ("box block", "box sticker")
    assert description.not_modelled == (
        "box top: in no contact and under no pad",
        "box sticker: in no contact and under no pad",
        "sphere other: in no contact and under no pad",
        "body table: rigidly attached to world; no cost",
        "body sticker: rigidly attached to block, merged into it with its mass; no cost",
        "pad pad: viscous markers have no history; no cost until their forces are evaluated",
        "contact between other and world, other and block: not in the scene file; no collision",
        "1 cameras: for drawing only",
        "MuJoCo's contact and solver settings: replaced by those of the scene file",
    )
    text = words(printed(capsys, str(own), "--no-timing"))
    for line in description.not_modelled:
        assert line in text
    assert "attached: sticker" in text
    assert "joint lift: slide along (0 0 1), range -1 to 1 m (stop 100 N/m), damping 3 N s/m" in text
    assert "actuator push: motor, force -2 to 5 N" in text
    assert "joint turn: hinge about (0 1 0), dry friction 0.1 N m" in text
    assert "actuator aim: position, k_p 4, k_d 0, control -1 to 1" in text
    assert "viscous per area: k_n 1000 N/m³, k_t 1 N s/m³, k_d 10 N s/m⁴, µ 0.8" in text


def test_elastic_pad_is_not_listed_as_free_of_cost(own: Path) -> None:
    scene = load_scene(own, overrides={"pads.pad.law": "elastic", "pads.pad.ks": 1.0})
    description = describe(scene)
    assert not any(line.startswith("pad pad") for line in description.not_modelled)
    assert description.size.anchors == 12
    assert [name for name, _ in with_duplicates(scene)] == ["contact stand", "pad pad: friction anchors of its markers"]


def test_viscous_markers_have_no_cost_until_evaluated() -> None:
    """No state, no unknowns, and the same motion with a hundred times as many markers."""
    few, many = (load_scene("rolling", overrides={"pads.pad.rows": n, "pads.pad.cols": n}) for n in (10, 100))
    assert describe(few).size.state_bytes == describe(many).size.state_bytes


@pytest.mark.parametrize("law", FRICTION_LAWS)
@pytest.mark.parametrize("name", scene_names())
def test_duplicated_part_does_not_change_the_motion(name: str, law: str) -> None:
    """A scene with a duplicate takes the same steps and Newton iterations."""
    scene = load_scene(name, friction=law, overrides={"pads.*.rows": 8, "pads.*.cols": 8} if name == "rolling" else {})
    u = holding_controls(scene)

    def run(sim: Simulator) -> tuple[Any, ...]:
        sim.q[:] = scene.q0
        sim.step(u, 100)
        sim.check()
        return sim.q.tolist(), sim.v.tolist(), sim.iterations.tolist()

    alone = Simulator(scene)
    expected = run(alone)
    twice = with_duplicates(scene)
    assert len(twice) == len({c.group for c in scene.contacts}) + len(scene.pads)
    for part, sim in twice:
        assert run(sim) == expected
        second = [i for i, n in enumerate(sim.model.contact_names) if n.endswith(" again")]
        assert len(second) == (0 if part.startswith("pad") else len(sim.model.contact_names) - len(scene.contacts))
        assert (sim.wrenches()[0, second] == 0).all()
        # The second one remembers as many points: it is computed like the first.
        assert sim.anchored.sum() >= alone.anchored.sum()


def test_holding_controls_keep_the_scene_at_its_start() -> None:
    scene = load_scene("insertion")
    u = holding_controls(scene)
    assert u[scene.u("arm_z")] == scene.q0[2] == 0.0555
    assert u[scene.u("hold_left")] == -0.0175
    assert u[scene.u("finger_left")] == 0
    sim = Simulator(scene)
    sim.step(u, 100)
    np.testing.assert_allclose(sim.q[0, :6], scene.q0[:6], atol=5e-3)


def test_times_of_parts_add_up_to_the_step(capsys: pytest.CaptureFixture[str]) -> None:
    description = json.loads(printed(capsys, "insertion", "--json", "--repeats", "2"))["times"]
    names = [part["name"] for part in description["parts"]]
    assert names[:2] == ["call from Python", "bodies, joints, actuators, solver"]
    assert names[2:6] == [f"contact {name}" for name in ("pad_left", "pad_right", "part_hole", "part_floor")]
    assert names[6:] == [f"pad {side}: friction anchors of its markers" for side in ("left", "right")]
    assert sum(part["microseconds"] for part in description["parts"]) == pytest.approx(description["whole"])
    assert sum(part["share"] for part in description["parts"]) == pytest.approx(1)
    assert description["whole"] > 0 and description["at_start"] > 0 and description["reading"] > 0
    assert description["repeats"] == 2 and description["timed_steps"] == 20 and description["run_steps"] == 100


def test_scene_without_contacts_and_pads_is_timed(own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bare = SCENE.splitlines()[:5]
    own.write_text("\n".join(bare), encoding="utf-8")
    times = measure(load_scene(own), repeats=1)
    assert [part.name for part in times.parts] == ["call from Python", "bodies, joints, actuators, solver"]
    assert times.reading is None
    text = printed(capsys, str(own), "--repeats", "1")
    assert "contacts: none" in text and "pads: none" in text and "one reading of all markers" not in text


def test_printed_times_fit_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    out = printed(capsys, "pushing", "--repeats", "1")
    assert max(map(len, out.splitlines())) <= 80
    assert "whole step" in out and "one reading of all markers" in out and "differences of whole steps" in words(out)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["insertin"], "no scene 'insertin'; did you mean 'insertion'? (or give a .toml, .xml or .urdf file)"),
        (["nowhere.toml"], "no such file: nowhere.toml"),
        (["rolling", "--repeats", "0"], "--repeats must be at least 1, got 0"),
    ],
)
def test_invalid_arguments_give_one_line_errors(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["describe", *arguments]) == 2
    assert capsys.readouterr().err == f"gelflow describe: {message}\n"


def test_changed_model_file_raises(own: Path) -> None:
    scene = load_scene(own)
    shutil.copy(load_scene("rolling").path.with_suffix(".xml"), own.with_suffix(".xml"))
    with pytest.raises(UsageError, match="has other bodies than the loaded scene"):
        describe(scene)
