"""Pads of every shape: positions and axes of the markers, and error messages."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gelflow.errors import UsageError
from gelflow.sim.benchmark.describe import describe
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.simulator import Simulator

MODEL = """<mujoco>
  <worldbody>
    <geom name="ground" type="plane" size="1 1 1"/>
    <body name="finger" pos="0 0 0.1">
      <joint name="slide" type="slide" axis="0 0 1"/>
      <geom name="finger" type="sphere" size="0.01"/>
      <site name="tip" pos="0.001 0 0" xyaxes="1 0 0 0 -1 0"/>
    </body>
    <body name="cap">
      <joint name="turn" type="hinge" axis="0 0 1"/>
      <geom name="cap" type="KIND" size="0.02 0.03 0.04" pos="0.3 0 0.1"/>
    </body>
  </worldbody>
</mujoco>"""

SCENE = """format = 1
model = "s.xml"
step = 0.005
[pads.pad]
site = "tip"
PAD
against = ["cap", "ground"]
kn = 1.0
kt = 1.0
mu = 1.0
kd = 1.0
"""


def loaded(folder: Path, pad: str, kind: str = "cylinder", overrides: dict[str, Any] | None = None) -> Scene:
    (folder / "s.xml").write_text(MODEL.replace("KIND", kind))
    (folder / "s.toml").write_text(SCENE.replace("PAD", pad))
    return load_scene(folder / "s.toml", overrides=overrides)


def check_frames(axes: np.ndarray) -> None:
    np.testing.assert_allclose(np.swapaxes(axes, 1, 2) @ axes, np.tile(np.eye(3), (len(axes), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(axes), 1)


def test_hemisphere(tmp_path: Path) -> None:
    """Nearly uniform markers on the half in direction z of the site, with axes of the smallest rotation."""
    text = 'shape = "hemisphere"\nradius = 0.01\ncount = 302\nstiffness = "per area"'
    pad = loaded(tmp_path, text).pads[0]
    outward = (pad.positions - [0.001, 0, 0]) / 0.01
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), 1)
    np.testing.assert_allclose(pad.axes[..., 2], outward, atol=1e-12)
    assert (outward[:, 2] < 0).all()  # z of the site points down
    check_frames(pad.axes)
    # The smallest rotation to this z: the trace of the rotation matrix is 1 + 2 cos(angle).
    site = np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(np.trace(site.T @ pad.axes, axis1=1, axis2=2), 1 - 2 * outward[:, 2], atol=1e-12)
    gaps = np.linalg.norm(pad.positions[:, None] - pad.positions, axis=-1) + np.eye(302)
    spacing = np.sqrt(2 * np.pi * 0.01**2 / 302)
    assert (gaps.min(1) > 0.7 * spacing).all() and (gaps.min(1) < 1.2 * spacing).all()
    assert pad.weights.sum() == pytest.approx(2 * np.pi * 0.01**2)
    assert pad.grid is None and pad.shape == "hemisphere"


def test_disc(tmp_path: Path) -> None:
    text = 'shape = "disc"\nradius = 0.018\ncount = 130\ncenter = [0.002, 0.0]\nstiffness = "per area"'
    scene = loaded(tmp_path, text)
    pad = scene.pads[0]
    apart = np.linalg.norm(pad.positions - [0.003, 0, 0], axis=1)
    assert apart.max() < 0.018 and (apart < 0.009).mean() == pytest.approx(0.25, abs=0.01)
    np.testing.assert_array_equal(pad.positions[:, 2], 0)
    np.testing.assert_allclose(pad.axes, np.tile(np.diag([1.0, -1, -1]), (130, 1, 1)), atol=1e-12)
    assert pad.weights.sum() == pytest.approx(np.pi * 0.018**2)
    with pytest.raises(UsageError, match="pad 'pad' is not a rectangle and has no marker grid"):
        _ = scene.grids
    info = describe(scene).pads[0]
    assert (info.shape, info.markers, info.rows, info.pitch_mm) == ("disc", 130, None, None)


POINTS = np.array([[0.0, 0, 0.01], [0.01, 0, 0], [0, 0.01, 0], [0, 0, -0.01]])
NORMALS = POINTS * 250  # not normalized


@pytest.mark.parametrize("source", ["toml", "csv", "npz"])
def test_listed_points(tmp_path: Path, source: str) -> None:
    x_axes = np.array([[1.0, 0, 0], [0, 0, 2], [1, 1, 0], [1, 0, 1]])
    if source == "toml":
        text = f"positions = {POINTS.tolist()}\nnormals = {NORMALS.tolist()}\nx_axes = {x_axes.tolist()}"
    else:
        text = f'file = "markers.{source}"'
        if source == "csv":
            columns = np.hstack([POINTS, NORMALS, x_axes])
            np.savetxt(tmp_path / "markers.csv", columns, delimiter=",", header="x, y, z", encoding="utf-8-sig")
        else:
            np.savez(tmp_path / "markers.npz", positions=POINTS, normals=NORMALS, x_axes=x_axes)
    pad = loaded(tmp_path, f'shape = "points"\n{text}').pads[0]
    site = np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(pad.positions, POINTS @ site + [0.001, 0, 0], atol=1e-15)
    check_frames(pad.axes)
    local_axes = site @ pad.axes
    np.testing.assert_allclose(local_axes[..., 2], POINTS / 0.01, atol=1e-12)
    np.testing.assert_allclose(local_axes[..., 0], [[1, 0, 0], [0, 0, 1], [1, 0, 0], [1, 0, 0]], atol=1e-12)
    assert (pad.weights == 1).all()


def test_default_axes_of_listed_points(tmp_path: Path) -> None:
    site = np.diag([1.0, -1.0, -1.0])
    no_normals = loaded(tmp_path, f'shape = "points"\npositions = {POINTS.tolist()}').pads[0]
    np.testing.assert_allclose(site @ no_normals.axes, np.tile(np.eye(3), (4, 1, 1)), atol=1e-12)
    with_normals = loaded(
        tmp_path, f'shape = "points"\npositions = {POINTS.tolist()}\nnormals = {NORMALS.tolist()}'
    ).pads[0]
    check_frames(with_normals.axes)
    np.testing.assert_allclose((site @ with_normals.axes)[..., 2], POINTS / 0.01, atol=1e-12)
    np.testing.assert_allclose((site @ with_normals.axes)[3], np.diag([-1.0, 1, -1]), atol=1e-12)  # normal −z


def test_tactile_forces_are_in_marker_axes(tmp_path: Path) -> None:
    """A fingertip pressed into the ground: vertical forces, expressed in the axes of each marker."""
    scene = loaded(tmp_path, 'shape = "hemisphere"\nradius = 0.01\ncount = 40')
    sim = Simulator(scene)
    assert not sim.tactile().any()
    sim.q[0, 0] = -0.1
    tactile, axes = sim.tactile()[0], scene.pads[0].axes
    force = 1.0 * -scene.pads[0].positions[:, 2]  # k_n × depth
    assert (force > 0).all()
    np.testing.assert_allclose(tactile[:, 2], -force * axes[:, 2, 2], atol=1e-12)
    np.testing.assert_allclose(tactile[:, :2], force[:, None] * axes[:, 2, :2], atol=1e-12)


@pytest.mark.parametrize(
    ("kind", "ends"),
    [
        ("sphere", (0.02, 0.02, 0.02)),
        ("box", (0.02, 0.03, 0.04)),
        ("cylinder", (0.02, 0.02, 0.03)),
        ("capsule", (0.02, 0.02, 0.05)),
        ("ellipsoid", (0.02, 0.03, 0.04)),
    ],
)
def test_tactile_forces_on_every_shape(kind: str, ends: tuple[float, float, float], tmp_path: Path) -> None:
    """Markers 1 mm inside each extremal point of a body have a force; markers 1 mm outside have none."""
    center = np.array([0.299, 0, 0])  # of the body in the frame of the site
    inside = center + np.diag(ends) - 1e-3 * np.eye(3)
    positions = np.concatenate([inside, 2 * center - inside, inside + 2e-3 * np.eye(3)])
    scene = loaded(tmp_path, f'shape = "points"\npositions = {positions.tolist()}', kind)
    assert next(shape for shape in scene.shapes if shape.name == "cap").kind == kind
    force = np.linalg.norm(Simulator(scene).tactile()[0], axis=1)
    np.testing.assert_allclose(force, [1e-3] * 6 + [0] * 3, atol=1e-12)


@pytest.mark.parametrize(
    ("kind", "text", "message"),
    [
        ("sphere", "count = 20", ""),
        ("sphere", 'faces = ["+z"]', "without a count 'cap' is one exact contact point, which takes no other keys"),
        (
            "capsule",
            'count = 20\nfaces = ["wall"]',
            "faces of a capsule must be some of -z, +z, each named once, got ['wall']",
        ),
        ("ellipsoid", "count = 20", ""),
        ("ellipsoid", "", "count is missing"),
        ("cylinder", 'faces = ["-z", "+z", "wall"]\nheights = 4', ""),
        ("cylinder", "heights = 4", 'heights apply to the wall; add faces = ["-z", "+z", "wall"]'),
    ],
)
def test_contact_points_on_round_geometries(kind: str, text: str, message: str, tmp_path: Path) -> None:
    loaded(tmp_path, "rows = 1\ncols = 1\npitch = 1e-3", kind)
    contact = '[contacts.c]\npoints = "cap"\nagainst = "finger"\nkn = 1.0\nkt = 1.0\nmu = 1.0\nkd = 1.0\n'
    path = tmp_path / "s.toml"
    path.write_text(f'{path.read_text()}[points.cap]\ngeom = "cap"\n{text}\n{contact}')
    if not message:
        scene = load_scene(path, friction="viscous")
        assert scene.points[0].radius == 0 and len(scene.points[0].points) in (20, 66 + 2 * 8)
        assert scene.points[0].points[:, 0].mean() == pytest.approx(0.3, abs=2e-3)
        return
    with pytest.raises(UsageError) as caught:
        load_scene(path)
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('shape = "hexagon"\nradius = 0.01', "shape is 'hexagon'; valid names: disc, hemisphere, points, rectangle"),
        ('shape = "disk"\nradius = 0.01', "shape is 'disk'; did you mean 'disc'?"),
        ('shape = "hemisphere"\nradius = 0.01\nrows = 3', "unknown key 'rows'"),
        ('shape = "hemisphere"\nradius = 0.01', "count is missing"),
        ('shape = "disc"\nradius = -1\ncount = 3', "radius must be a finite number ≥"),
        ('shape = "points"', "needs either positions or a file"),
        ('shape = "points"\nfile = "no.csv"', "no.csv: no such file in the folder of the scene"),
        ('shape = "points"\nfile = "s.toml"', "a file of markers must be .csv or .npz"),
        ('shape = "points"\nfile = "a.csv"\nnormals = [[0, 0, 1]]', "normals must be in the file"),
        ('shape = "points"\nfile = "two.csv"', "expected 3, 6 or 9 columns (position, normal, x axis), got 2"),
        ('shape = "points"\nfile = "words.csv"', "words.csv cannot be read"),
        ('shape = "points"\nfile = "words.npz"', "words.npz cannot be read"),
        ('shape = "points"\nfile = "array.npz"', "array.npz cannot be read"),
        ('shape = "points"\nfile = "cut.npz"', "cut.npz cannot be read"),
        ('shape = "points"\nfile = "bad.npz"', "bad.npz cannot be read"),
        ('shape = "points"\nfile = "other.npz"', "unknown array 'points'; valid names: positions, normals, x_axes"),
        ("rows = 2\ncols = 2\nsize = [-1, -1]", "pads.pad: size must be two positive numbers, got [-1.0, -1.0]"),
        ('shape = "points"\npositions = [[0, 0]]', "positions must be a list of [x, y, z], all finite"),
        ('shape = "points"\npositions = [[0, 0, nan]]', "positions must be a list of [x, y, z], all finite"),
        ('shape = "points"\npositions = "tip"', "positions must be a list of [x, y, z], all finite"),
        (
            'shape = "points"\npositions = [[0, 0, 0]]\nnormals = [[0, 0, 1], [0, 0, 1]]',
            "must have one entry per position, 1, got 2",
        ),
        ('shape = "points"\npositions = [[0, 0, 0]]\nnormals = [[0, 0, 0]]', "normals[0] has length 0"),
        ('shape = "points"\npositions = [[0, 0, 0]]\nx_axes = [[0, 0, 1]]', "x_axes[0] is parallel to the normal"),
        ('shape = "points"\npositions = [[0, 0, 0]]\nstiffness = "per area"', 'set stiffness = "per point"'),
    ],
)
def test_invalid_pad_gives_a_one_line_error(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "two.csv").write_text("1, 2\n")
    (tmp_path / "words.csv").write_text("x, y, z\n")
    (tmp_path / "words.npz").write_text("x, y, z\n")
    np.savez(tmp_path / "other.npz", points=POINTS)
    (tmp_path / "cut.npz").write_bytes((tmp_path / "other.npz").read_bytes()[:100])
    damaged = bytearray((tmp_path / "other.npz").read_bytes())
    damaged[150] ^= 255  # in the data of the first array
    (tmp_path / "bad.npz").write_bytes(damaged)
    with (tmp_path / "array.npz").open("wb") as array:
        np.save(array, POINTS)
    with pytest.raises(UsageError) as caught:
        loaded(tmp_path, text)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("against", "message"),
    [
        (["ground", "ground"], "pads.pad: against names 'ground' twice"),
        (["cap", "finger"], "pads.pad: 'finger' is on the body of the pad and cannot touch it"),
    ],
)
def test_shapes_that_a_pad_cannot_touch(against: list[str], message: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=message):
        loaded(tmp_path, "rows = 1\ncols = 1\npitch = 1e-3", overrides={"pads.pad.against": against})
