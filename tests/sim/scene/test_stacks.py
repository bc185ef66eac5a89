"""Bodies sampled with the default density rest on each other; a shape that fits between given points is announced."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from gelflow.errors import UsageError
from gelflow.geometry import rotate, yaw_quaternion
from gelflow.sim import Simulator, load_scene
from gelflow.sim.scene import Scene, scene_names

LAW = "kn = 2e3\nkt = 20\nmu = 0.8\nkd = 2e4\n"  # 0.2 kg on four points: 0.25 mm deep
CUBE = 'type="box" size="0.02 0.02 0.02"'
RAIL = 'type="box" size="0.06 0.003 0.003"'

# Geometry of the fixed body and of the body on it, height of the latter's centre, its offset in x, its turn [degrees].
PAIRS: dict[str, tuple[str, str, float, float, float]] = {
    "equal cubes": (CUBE, CUBE, 0.04, 0, 0),
    "equal cubes, offset": (CUBE, CUBE, 0.04, 0.012, 0),
    "equal cubes, turned": (CUBE, CUBE, 0.04, 0, 45),
    "equal cubes, offset and turned": (CUBE, CUBE, 0.04, 0.008, 30),
    "large on small": ('type="box" size="0.01 0.01 0.02"', 'type="box" size="0.04 0.04 0.01"', 0.03, 0.003, 0),
    "small on large": ('type="box" size="0.05 0.05 0.01"', 'type="box" size="0.005 0.005 0.005"', 0.015, 0, 20),
    "across a thin rail": ('type="box" size="0.1 0.002 0.002"', 'type="box" size="0.03 0.03 0.03"', 0.032, 0.01, 0),
    "across a turned rail": ('type="box" size="0.1 0.002 0.002"', 'type="box" size="0.03 0.03 0.03"', 0.032, 0, 30),
    "crossed rails": (RAIL, RAIL, 0.006, 0, 90),
    "rails crossed at 60°": (RAIL, RAIL, 0.006, 0, 60),
    "parallel rails": (RAIL, RAIL, 0.006, 0.02, 0),
    "equal cylinders": ('type="cylinder" size="0.02 0.01"', 'type="cylinder" size="0.02 0.01"', 0.02, 0, 0),
    "on a cylinder's rim": ('type="cylinder" size="0.02 0.02"', 'type="box" size="0.03 0.01 0.004"', 0.024, 0.014, 0),
    "cylinder on a cube": (CUBE, 'type="cylinder" size="0.01 0.02"', 0.04, 0.01, 0),
    "mesh on a cube": (CUBE, 'type="mesh" mesh="cube"', 0.04, 0, 0),
}
VERTICES = " ".join(f"{x} {y} {z}" for x in (-0.02, 0.02) for y in (-0.02, 0.02) for z in (-0.02, 0.02))


def stack(folder: Path, name: str, points: str = "", more: str = "") -> Scene:
    """The scene of a pair. `points` are keys of the points of the upper body, `more` is appended to the file."""
    lower, upper, *_ = PAIRS[name]
    (folder / "s.xml").write_text(
        f'<mujoco><asset><mesh name="cube" vertex="{VERTICES}"/></asset><worldbody><geom name="lower" {lower}/>'
        f'<body name="upper"><freejoint/><geom name="upper" {upper} mass="0.2"/></body></worldbody></mujoco>'
    )
    (folder / "s.toml").write_text(
        f'format = 1\nmodel = "s.xml"\nstep = 1e-3\n[points.upper]\ngeom = "upper"\n{points}\n'
        f'[contacts.down]\npoints = "upper"\nagainst = "lower"\n{LAW}{more}'
    )
    return load_scene(folder / "s.toml")


UP = f'[points.lower]\ngeom = "lower"\n[contacts.up]\npoints = "lower"\nagainst = "upper"\n{LAW}'


def _count(name: str) -> str:
    return "count = 400" if "mesh" in name else ""


def rest(scene: Scene, name: str) -> tuple[np.ndarray, float]:
    """Displacement [m] and tilt [rad] of the upper body half a second after it is put down."""
    *_, height, offset, turn = PAIRS[name]
    sim = Simulator(scene)
    start = np.array([offset, 0, height])
    sim.q[0] = [*start, *yaw_quaternion(np.radians(turn))]
    sim.step(np.zeros(0), 500)
    sim.check()
    return sim.q[0, :3] - start, float(np.arccos(min(1.0, rotate(sim.q[0, 3:], (0, 0, 1))[2])))


# One direction alone resolves the edge of the support to a spacing, and a large body has not enough points for a rail.
BOTH_DIRECTIONS = ("across a thin rail", "across a turned rail", "on a cylinder's rim")
CASES = [(name, False) for name in PAIRS if name not in BOTH_DIRECTIONS]
CASES += [(name, True) for name in PAIRS if "mesh" not in name]  # a mesh as a shape requires libigl


@pytest.mark.parametrize(("name", "both"), CASES, ids=[f"{n}, {'both' if b else 'one'}" for n, b in CASES])
def test_stacked_bodies_rest_on_each_other(name: str, both: bool, tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = stack(tmp_path, name, _count(name), more=UP if both else "")
    moved, tilt = rest(scene, name)
    assert -1e-3 < moved[2] <= 0
    assert np.abs(moved[:2]).max() < 1e-3
    assert tilt < 0.05


@pytest.mark.parametrize(
    ("name", "points", "advice"),
    [
        ("equal cubes", "resolution = [2, 2, 2]", "omit resolution, or add a contact of points on 'lower'"),
        ("equal cubes", "resolution = [3, 3, 2]", "omit resolution"),
        ("equal cylinders", 'angles = 24\nradii = 6\nfaces = ["-z"]', ""),
        ("across a thin rail", "resolution = [9, 9, 9]", "omit resolution"),
        ("across a thin rail", "", "; add a contact of points on 'lower' against 'upper'"),
        ("mesh on a cube", "count = 20", "increase count"),
    ],
)
def test_shape_that_fits_between_points_is_announced(name: str, points: str, advice: str, tmp_path: Path) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        stack(tmp_path, name, points)
    texts = [str(w.message) for w in caught]
    assert len(texts) == (1 if advice else 0)
    for text in texts:
        assert "points.upper: 'lower'" in text
        assert advice in text
        assert "\n" not in text


def test_points_in_the_opposite_direction_cover_a_contact(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = stack(tmp_path, "across a thin rail", "resolution = [2, 2, 2]", UP)
    moved, tilt = rest(scene, "across a thin rail")
    assert -1e-3 < moved[2] <= 0
    assert tilt < 0.05


@pytest.mark.parametrize("name", scene_names())
def test_shipped_scenes_have_no_gaps(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_scene(name)


def test_default_density_follows_the_sizes_of_both_partners(tmp_path: Path) -> None:
    one = stack(tmp_path, "small on large").points
    both = {p.name: len(p.points) for p in stack(tmp_path, "across a thin rail", more=UP).points}
    assert len(one[0].points) == 6**3 - 4**3  # three spacings per side and a row close to each edge
    assert both["lower"] < 4 * both["upper"] < 1000  # the rail adapts to the cube, not the cube to the rail
    plane = (tmp_path / "s.xml").read_text().replace('name="lower" type="box"', 'name="lower" type="plane"')
    (tmp_path / "s.xml").write_text(plane)
    text = (tmp_path / "s.toml").read_text()
    (tmp_path / "s.toml").write_text(text[: text.index("[points.lower]")])
    assert len(load_scene(tmp_path / "s.toml").points[0].points) == 8  # corners are exact on a plane


def test_points_in_no_contact_have_no_default_density(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"points.lower: in no contact, so without default density; give resolution"):
        stack(tmp_path, "equal cubes", more='[points.lower]\ngeom = "lower"\n')


def test_wrong_names_of_a_contact_are_reported_before_the_density_of_its_points(tmp_path: Path) -> None:
    contact = "[contacts.wrong]\n{}\nkn = 1\nkt = 1\nkd = 1\nmu = 1\n"
    for names, message in (
        ('points = "lowr"\nagainst = "upper"', "contacts.wrong: no points 'lowr'; did you mean 'lower'"),
        ('points = "lower"\nagainst = "uper"', "contacts.wrong: no geometry 'uper'; did you mean 'upper'"),
    ):
        with pytest.raises(UsageError, match=message):
            stack(tmp_path, "equal cubes", more='[points.lower]\ngeom = "lower"\n' + contact.format(names))
