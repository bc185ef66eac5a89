"""Loading of scene files: agreement with MuJoCo, overrides, and one-line errors."""

import shutil
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim import _core
from gelflow.sim.scene import Scene, load_scene, scene_names

SHIPPED = ("dclaw", "grasp", "insertion", "pushing", "rolling")


def rotation(quat: NDArray[np.float64]) -> NDArray[np.float64]:
    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, np.asarray(quat, dtype=float))
    return flat.reshape(3, 3)


def rotation_about(axis: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    quat = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quat, axis, angle)
    return rotation(quat)


def body_frames(spec: _core.ModelSpec, q: NDArray[np.float64]) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Positions and rotations of the bodies at q, by an independent implementation of the kinematics."""
    frames: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
    at = 0
    joints = spec.joints
    for index, body in enumerate(spec.bodies):
        base_pos, base_rot = frames[body.parent] if body.parent >= 0 else (np.zeros(3), np.eye(3))
        x, r = base_pos + base_rot @ body.pos, base_rot @ rotation(body.quat)
        for joint in joints:
            if joint.body != index:
                continue
            if joint.type == "free":
                x, r = q[at : at + 3], rotation(q[at + 3 : at + 7])
                at += 7
                continue
            if joint.type == "slide":
                x = x + r @ joint.axis * q[at]
            else:
                rotated = r @ rotation_about(joint.axis, q[at])
                x, r = x + r @ joint.pos - rotated @ joint.pos, rotated
            at += 1
        frames.append((x, r))
    return frames


def reference(scene: Scene) -> Any:
    return mujoco.MjModel.from_xml_path(str(scene.path.with_suffix(".xml")))


def test_scene_names() -> None:
    assert scene_names() == SHIPPED


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize("friction", ["viscous", "elastic"])
def test_frames_agree_with_mujoco(name: str, friction: str) -> None:
    scene = load_scene(name, friction=friction)
    spec, model = scene.model_spec(), reference(scene)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(3)
    for _ in range(5):
        q = rng.normal(size=scene.nq)
        mujoco.mj_normalizeQuat(model, q)
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        for body, (x, r) in zip(scene.bodies, body_frames(spec, q), strict=True):
            index = model.body(body.name).id
            np.testing.assert_allclose(x, data.xpos[index], atol=1e-12)
            np.testing.assert_allclose(r, data.xmat[index].reshape(3, 3), atol=1e-12)
        for pad in scene.pads:
            x, r = body_frames(spec, q)[pad.body]
            site = model.site(_site_of(scene, pad.name)).id
            axes = data.site_xmat[site].reshape(3, 3)
            if pad.grid is None:
                center = (
                    x + pad.positions @ r.T - 0.01 * (r @ pad.axes)[..., 2]
                )  # of the sphere, computed from each marker
                np.testing.assert_allclose(center, np.tile(data.site_xpos[site], (302, 1)), atol=1e-12)
                assert ((r @ pad.axes)[..., 2] @ axes[:, 2] > 0).all()
                continue
            corner = np.array([*(pad.grid.positions()[0] * 1e-3), 0])
            np.testing.assert_allclose(x + r @ pad.positions[0], data.site_xpos[site] + axes @ corner, atol=1e-12)
            np.testing.assert_allclose(r @ pad.axes, np.tile(axes, (len(pad.axes), 1, 1)), atol=1e-12)


def _site_of(scene: Scene, pad: str) -> str:
    gripper = f"pad_{pad}"
    return {"dclaw": pad, "grasp": gripper, "insertion": gripper}.get(scene.name, "pad_face")


@pytest.mark.parametrize("name", SHIPPED)
def test_mass_and_inertia_agree_with_mujoco_fusestatic(name: str, tmp_path: Path) -> None:
    scene = load_scene(name)
    text = scene.path.with_suffix(".xml").read_text().replace("<compiler ", '<compiler fusestatic="true" ')
    merged = mujoco.MjModel.from_xml_string(text)
    for body in scene.model_spec().bodies:
        index = merged.body(body.name).id
        assert body.mass == pytest.approx(merged.body_mass[index], rel=1e-12)
        np.testing.assert_allclose(body.com, merged.body_ipos[index], atol=1e-12)
        axes = rotation(merged.body_iquat[index])
        expected = axes @ np.diag(merged.body_inertia[index]) @ axes.T
        xx, yy, zz, xy, xz, yz = body.inertia
        full = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        np.testing.assert_allclose(full, expected, atol=1e-9 * expected.max())


def test_merged_inertia_is_about_the_common_centre_of_mass(tmp_path: Path) -> None:
    """Closed form for two unit cubes, 1 m apart, one of them on a body without a joint."""
    write(tmp_path, BLOCKS)
    scene = load_scene(tmp_path / "s.toml")
    body = scene.model_spec().bodies[0]
    assert body.mass == pytest.approx(2)
    np.testing.assert_allclose(body.com, [0, 0, 0.5])
    np.testing.assert_allclose(body.inertia, [1 / 3 + 0.5, 1 / 3 + 0.5, 1 / 3, 0, 0, 0], atol=1e-12)


def test_pad_frames_follow_the_observation_format() -> None:
    """x points from base to tip (down), z outwards to the other finger; sensor 0 is at −x."""
    scene = load_scene("insertion")
    model = reference(scene)
    data = mujoco.MjData(model)
    data.qpos[:] = scene.q0
    mujoco.mj_kinematics(model, data)
    for pad, outward in zip(scene.pads, (1.0, -1.0), strict=True):
        axes = data.xmat[model.body(scene.bodies[pad.body].name).id].reshape(3, 3) @ pad.axes[0]
        np.testing.assert_allclose(axes[:, 0], [0, 0, -1], atol=1e-12)
        np.testing.assert_allclose(axes[:, 2], [outward, 0, 0], atol=1e-12)
        np.testing.assert_allclose(axes[:, 1], np.cross(axes[:, 2], axes[:, 0]), atol=1e-12)
        position = data.site_xpos[model.site(f"pad_{pad.name}").id]
        np.testing.assert_allclose(position, [-outward * 0.0175, 0, 0.0555], atol=1e-12)  # on the face of the part
    assert scene.pads[0].name == "left"
    assert scene.marker_slice("right") == slice(130, 260)


def test_hole_matches_the_publication() -> None:
    scene = load_scene("insertion")
    boxes = {
        s.name: (s.pose.position - s.size, s.pose.position + s.size) for s in scene.shapes if s.name.startswith("wall")
    }
    assert boxes["wall_right"][0][0] - boxes["wall_left"][1][0] == pytest.approx(39.5e-3)
    assert boxes["wall_back"][0][1] - boxes["wall_front"][1][1] == pytest.approx(54.5e-3)
    assert {high[2] for _, high in boxes.values()} == {0.025}


def test_reference_pad_matches_the_published_markers() -> None:
    """First and last marker of the published data, which are ordered row by row."""
    scene = load_scene("pushing")
    spec = scene.model_spec()
    x, r = body_frames(spec, np.zeros(7))[scene.pads[0].body]
    markers = x + scene.pads[0].positions @ r.T
    np.testing.assert_allclose(markers[:, 0], 0.02 + 0.004 + 0.0015, atol=1e-12)
    np.testing.assert_allclose(markers[0, 1:], [-0.00675, 0.18 - 0.1472 + 0.007], atol=1e-12)
    np.testing.assert_allclose(markers[-1, 1:], [0.00675, 0.18 - 0.1472 - 0.011], atol=1e-12)


def test_unused_geometry_is_not_modelled(tmp_path: Path) -> None:
    write(tmp_path, BLOCKS)
    scene = load_scene(tmp_path / "s.toml")
    assert [shape.name for shape in scene.shapes] == ["ground"]
    assert any("ornament" in line for line in scene.not_modelled)


def test_names_and_indices() -> None:
    scene = load_scene("insertion")
    assert (scene.nq, scene.nv, scene.nu) == (13, 12, 8)
    assert scene.q("part") == slice(6, 13)
    assert scene.v("part") == slice(6, 12)
    assert scene.q("arm_yaw") == slice(3, 4)
    assert scene.u("finger_right") == 5
    assert len(scene.contact_names("part_hole")) == 4
    with pytest.raises(UsageError, match="no joint 'arm_w'; did you mean 'arm_"):
        scene.q("arm_w")
    with pytest.raises(UsageError, match="no actuator 'grip'"):
        scene.u("grip")


def test_parameters_depend_on_the_friction_law() -> None:
    viscous = load_scene("insertion", friction="viscous")
    elastic = load_scene("insertion", friction="elastic")
    assert viscous.contacts[0].params == {"kn": 8e3, "kt": 80.0, "mu": 1.5, "kd": 1e3, "ks": 0.0}
    assert elastic.contacts[0].law == "elastic" and elastic.contacts[0].params["ks"] > 0
    assert viscous.pads[0].law == "viscous" and elastic.pads[0].law == "elastic"
    rolling = load_scene("rolling", friction="elastic")
    assert {c.name: c.law for c in rolling.contacts} == {"pad_ball": "elastic", "ball_ground": "viscous"}


def test_exact_sphere_contact_has_no_anchor() -> None:
    with pytest.raises(UsageError, match='set law = "viscous" for this contact'):
        load_scene("rolling", overrides={"contacts.ball_ground.law": "elastic", "contacts.ball_ground.ks": 1.0})
    with pytest.raises(UsageError, match="supports planes only; sample 'pad' instead"):
        load_scene("rolling", overrides={"contacts.ball_ground.against": "pad"})


def test_overrides_replace_values_and_are_checked() -> None:
    scene = load_scene("rolling", overrides={"pads.pad.rows": 50, "pads.pad.cols": 50, "step": 1e-3})
    assert scene.num_markers == 2500
    assert scene.step == 1e-3
    assert scene.grids[0].pitch == pytest.approx(1.0)
    assert np.abs(scene.pads[0].positions[:, :2]).max() == pytest.approx(0.0245)
    counted = {"pads.pad.rows": np.int64(50), "pads.pad.cols": np.int64(50), "step": np.float32(0.5)}
    assert load_scene("rolling", overrides=counted).num_markers == 2500
    both = load_scene("insertion", overrides={"pads.*.rows": 18, "pads.*.cols": 14})
    assert both.num_markers == 2 * 18 * 14
    for key, message in [
        ("pads.pad.row", "unknown key 'row'; did you mean 'rows'"),
        ("pads.pda.rows", "no table 'pda'; did you mean 'pad'"),
        ("stp", "unknown key 'stp'; did you mean 'step'"),
    ]:
        with pytest.raises(UsageError, match=message):
            load_scene("rolling", overrides={key: 1})


def test_area_weights_reach_the_model(tmp_path: Path) -> None:
    scene = load_scene(
        "rolling",
        overrides={"points.pad.stiffness": "per area", "pads.pad.stiffness": "per area", "pads.pad.rows": 200},
    )
    spec = scene.model_spec()
    assert sum(spec.points[0].weights or []) == pytest.approx(2 * (0.05 * 0.05 + 2 * 0.05 * 0.01))
    assert sum(spec.pads[0].weights or []) == pytest.approx(0.05 * 0.05)
    assert sum(load_scene("rolling").model_spec().points[0].weights or []) == 2168


BLOCKS = {
    "s.xml": """<mujoco>
  <worldbody>
    <geom name="ground" type="plane" size="1 1 1"/>
    <body name="block">
      <joint name="slide" type="slide" axis="0 0 1"/>
      <geom name="block" type="box" size="0.5 0.5 0.5" density="1"/>
      <geom name="ornament" type="capsule" size="0.1 0.2" mass="0"/>
      <body name="top" pos="0 0 1">
        <geom name="top" type="box" size="0.5 0.5 0.5" density="1"/>
        <site name="face"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slide"/></actuator>
</mujoco>""",
    "s.toml": """format = 1
model = "s.xml"
step = 0.005
[points.block]
geom = "block"
resolution = [2, 2, 2]
[contacts.block_ground]
points = "block"
against = "ground"
kn = 1.0
kt = 1.0
mu = 1.0
kd = 1.0
[pads.face]
site = "face"
rows = 2
cols = 2
pitch = 1e-3
against = "ground"
kn = 1.0
kt = 1.0
mu = 1.0
kd = 1.0
""",
}


def write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).write_text(text)


INVALID_TOML = [
    ('model = "s.xml"', 'modell = "s.xml"', "unknown key 'modell'; did you mean 'model'"),
    ("[contacts.block_ground]", "[contact.block_ground]", "unknown key 'contact'; did you mean 'contacts'"),
    ("kn = 1.0", "kn = 1.0\nknn = 2", "unknown key 'knn'; did you mean 'kn'"),
    ("kn = 1.0", 'kn = 1.0\ndamping = "depth"', "damping is 'depth'; it is now called 'hunt-crossley'"),
    ("kn = 1.0", 'kn = 1.0\ndamping = "plain"', "damping is 'plain'; it is now called 'linear'"),
    ("format = 1", "format = 2", "format is 2; this gelflow reads format 1"),
    ("step = 0.005", "", "step is missing"),
    ("step = 0.005", 'step = "5 ms"', "step must be a finite number"),
    ("step = 0.005", "step = nan", "step must be a finite number"),
    ("step = 0.005", 'step = 0.005\nfriction = "elastik"', "friction is 'elastik'; did you mean 'elastic'"),
    ("step = 0.005", 'step = 0.005\nfriction = "elastic"', "ks is missing"),
    ('geom = "block"', 'geom = "blok"', "no geometry 'blok'; did you mean 'block'"),
    (
        'geom = "block"',
        'geom = "ground"',
        "plane 'ground' cannot be sampled; supported: box, cylinder, sphere, capsule, ellipsoid, mesh",
    ),
    ('geom = "block"', 'geom = "ornament"', "unknown key 'resolution'; valid names: count, faces, geom, stiffness"),
    ('against = "ground"', 'against = "top"', "on one body"),
    ('site = "face"', 'site = "fase"', "no site 'fase'; did you mean 'face'"),
    ("rows = 2", "rows = 0", "rows must be an integer"),
    ("pitch = 1e-3", "", "give either pitch"),
    ("resolution = [2, 2, 2]", "resolution = [2, 2]", "resolution must be 3 integers"),
    ("resolution = [2, 2, 2]", "resolution = [2.7, 2, 2]", "resolution must be 3 integers, got [2.7, 2, 2]"),
    ("kn = 1.0", "kn = -1.0", "kn must be a finite number ≥ 0"),
    ("step = 0.005", "step = 0.005\n[joints.slidee]\nlimit_stiffness = 1.0", "no joint 'slidee'; did you mean 'slide'"),
    ("step = 0.005", "step = 0.005\n[joints.slide]\nlimit_stiffness = 1.0", "has no range in the model"),
    ("format = 1", "format = = 1", "not valid TOML"),
    ("s.xml", "t.xml", "no such model file"),
]


@pytest.mark.parametrize(("old", "new", "message"), INVALID_TOML, ids=[f[2] for f in INVALID_TOML])
def test_invalid_scene_file_gives_a_one_line_error(old: str, new: str, message: str, tmp_path: Path) -> None:
    assert old in BLOCKS["s.toml"]
    write(tmp_path, {**BLOCKS, "s.toml": BLOCKS["s.toml"].replace(old, new, 1)})
    check_error(tmp_path / "s.toml", message)


INVALID_MODELS = [
    ('<joint name="slide" type="slide" axis="0 0 1"/>', '<joint name="slide" type="ball"/>', "on ball joint 'slide'"),
    ('type="capsule" size="0.1 0.2"', 'type="mesh" mesh="m"', "m"),
    ("</worldbody>", "</worldbody><asset><mesh name='m' file='missing.obj'/></asset>", "mesh 'm': no file missing.obj"),
    ("<worldbody>", "<worldboddy>", "s.xml"),
]


@pytest.mark.parametrize(("old", "new", "message"), INVALID_MODELS, ids=[f[2] for f in INVALID_MODELS])
def test_invalid_model_file_gives_a_one_line_error(old: str, new: str, message: str, tmp_path: Path) -> None:
    assert old in BLOCKS["s.xml"]
    write(tmp_path, {**BLOCKS, "s.xml": BLOCKS["s.xml"].replace(old, new, 1)})
    check_error(tmp_path / "s.toml", message)


def check_error(path: Path, message: str) -> None:
    with pytest.raises(UsageError) as caught:
        load_scene(path)
    text = str(caught.value)
    assert message in text
    assert "\n" not in text


def test_missing_scene_is_an_error(tmp_path: Path) -> None:
    check_error(tmp_path / "none.toml", "no such file")
    with pytest.raises(UsageError, match="no scene 'insertoin'; did you mean 'insertion'"):
        load_scene("insertoin")


def test_copied_scene_is_loaded_from_its_folder(tmp_path: Path) -> None:
    shipped = load_scene("pushing")
    for suffix in (".toml", ".xml"):
        shutil.copy(shipped.path.with_suffix(suffix), tmp_path)
    copied = load_scene(str(tmp_path / "pushing.toml"))
    assert copied.nq == 7
    np.testing.assert_array_equal(copied.q0, shipped.q0)


def test_urdf_is_loaded(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(
        """<robot name="arm"><mujoco><compiler fusestatic="false"/></mujoco>
        <link name="base"/><link name="tip"><inertial><mass value="2"/>
        <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
        <joint name="turn" type="continuous"><parent link="base"/><child link="tip"/><axis xyz="0 0 1"/></joint>
        </robot>"""
    )
    (tmp_path / "arm.toml").write_text('format = 1\nmodel = "arm.urdf"\nstep = 0.005\n')
    scene = load_scene(tmp_path / "arm.toml")
    assert [(j.name, j.type) for j in scene.joints] == [("turn", "hinge")]
    assert scene.bodies[0].mass == 2


def test_loading_leaves_no_log_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo writes its warnings into a file of the working directory."""
    body = '<body name="hand"><joint/><geom size="0.1"/></body>'
    (tmp_path / "child.xml").write_text(f'<mujoco><option impratio="10"/><worldbody>{body}</worldbody></mujoco>')
    (tmp_path / "parent.xml").write_text(
        '<mujoco><asset><model name="c" file="child.xml"/></asset><worldbody><body><joint/><geom size="0.1"/>'
        '<attach model="c" body="hand" prefix="x_"/></body></worldbody></mujoco>'
    )
    monkeypatch.chdir(tmp_path)
    with pytest.warns(UserWarning, match="Attach conflict"):
        load_scene(tmp_path / "parent.xml")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["child.xml", "parent.xml"]
