"""Holes that are meshes: clearance, symmetry, the frame of the mesh, insertions and errors."""

from pathlib import Path

import numpy as np
import pytest
from tests.sim.tasks.parts.harness import both_depths, make_attempts

from gelflow.errors import UsageError
from gelflow.sim.scene.geometry.mesh import TriangleMesh
from gelflow.sim.tasks.parts import load_part, part_geometry
from gelflow.sim.tasks.parts.shipped_meshes import obj_text, prism
from gelflow.task import InsertionTask

PEG = """format = 1
[part]
shape = "cylinder"
diameter = 0.020
height = 0.060
[hole]
file = "hole.obj"
scale = 0.001
[grasp]
height = [-0.003, 0.007]
"""


def octagon(radius: float) -> np.ndarray:
    angle = np.radians(22.5 + 45 * np.arange(8))
    corners = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(corners * radius / np.cos(np.radians(22.5)))


def block(opening: np.ndarray, height: float = 25.0, *, radius: float = 20.0) -> TriangleMesh:
    """A round block [mm] with a convex opening from top to bottom."""
    count, centre = len(opening), opening.mean(0)
    outward = opening - centre
    outer = centre + radius * outward / np.linalg.norm(outward, axis=1)[:, None]
    rings = [(outer, 0.0), (outer, height), (opening, height), (opening, 0.0)]
    vertices = np.concatenate([np.column_stack([ring, np.full(count, z)]) for ring, z in rings])
    here = np.arange(count)
    following = np.roll(here, -1)
    faces = []
    for i in range(4):
        a, b = i * count, (i + 1) % 4 * count
        faces += [np.column_stack([a + here, a + following, b + following])]
        faces += [np.column_stack([a + here, b + following, b + here])]
    return TriangleMesh(vertices, np.concatenate(faces))


def written(tmp_path: Path, hole: TriangleMesh, text: str = PEG) -> Path:
    (tmp_path / "hole.obj").write_text(obj_text(hole))
    (tmp_path / "part.toml").write_text(text)
    return tmp_path / "part.toml"


@both_depths
def test_a_round_peg_in_an_octagonal_hole_is_inserted_where_it_fits(tmp_path: Path, deep: bool) -> None:
    task = load_part(written(tmp_path, block(octagon(10.8))))
    part = task.part
    assert part.clearance == pytest.approx((1.6e-3, 1.6e-3), abs=0.06e-3)
    assert (part.depth, part.symmetry, set(part.mirror)) == (0.025, 0, {"x", "y"})
    attempts = make_attempts(4, task, deep=deep)
    rng = np.random.default_rng(0)
    attempts.draw(rng, misalignment=np.array([[0, 0, 0], [0.7e-3, 0, 0], [2e-3, 0, 0], [0, -3e-3, 0]]))
    result = attempts.attempt(rng)
    assert result.inserted.tolist() == [True, True, False, False]
    assert not result.failed.any()


def test_the_mesh_of_a_hole_equals_the_outline_with_the_same_clearance(tmp_path: Path) -> None:
    """Distances in the plane of a box in a rectangular hole, whose mesh is not at the origin of a part's mesh."""
    corners = np.array([[-10, -15], [10, -15], [10, 15], [-10, 15]], dtype=float)
    shift = np.array([4.0, -7.0])
    (tmp_path / "part.obj").write_text(obj_text(prism(corners + shift, 60.0)))
    mesh = block(corners * [1.1, 1.2], radius=30.0)
    mesh = TriangleMesh(mesh.vertices + np.array([*shift, 12.0]), mesh.faces)
    text = PEG.replace('"cylinder"\ndiameter = 0.020\nheight = 0.060', '"mesh"\nfile = "part.obj"\nscale = 0.001')
    part = load_part(written(tmp_path, mesh, text)).part
    assert part.hole_origin == pytest.approx((4e-3, -7e-3))
    assert part.clearance == pytest.approx((2e-3, 2e-3), abs=0.06e-3)
    points = np.random.default_rng(0).uniform(-1, 1, (200, 2)) * [10e-3, 16e-3]
    expected = np.maximum(np.abs(points[:, 0]) - 11e-3, np.abs(points[:, 1]) - 18e-3)
    np.testing.assert_allclose(part_geometry(part).hole.distance(points), expected, atol=0.06e-3)


def test_a_hole_without_mirror_symmetry_takes_it_from_the_part(tmp_path: Path) -> None:
    opening = octagon(11.0) + np.array([0.4, 0.0])
    part = load_part(written(tmp_path, block(opening))).part
    assert part.mirror == ("y",)
    assert part.clearance[0] == pytest.approx(1.2e-3, abs=0.06e-3)
    given = PEG + "[symmetry]\nmirror = []\n"
    assert load_part(written(tmp_path, block(opening), given)).part.mirror == ()


def test_a_description_names_its_hole_by_the_digest(tmp_path: Path) -> None:
    task = load_part(written(tmp_path, block(octagon(10.8))))
    copied = InsertionTask.from_json(task.to_json())
    assert copied == task and copied.digest() == task.digest()
    assert "hole_file" not in task.to_json()["part"]
    assert "hole_mesh" not in load_part("peg").to_json()["part"]
    with pytest.raises(UsageError, match="hole of part 'part' is a mesh"):
        _ = part_geometry(copied.part).hole
    other = load_part(written(tmp_path, block(octagon(11.8))))
    assert other.digest() != task.digest()


@pytest.mark.parametrize(
    ("opening", "text", "message"),
    [
        (octagon(9.5), PEG, "overlaps the mesh of its hole by 0.5"),
        (octagon(5) + 15, PEG, "no hole under the part"),
        (octagon(10.8), PEG.replace("scale", "clearance"), "unknown key|clearance"),
        (octagon(10.8), PEG.replace("[grasp]", "depth = 0.03\n[grasp]"), "depth must be at most 0.025"),
    ],
)
def test_an_impossible_hole_is_refused(tmp_path: Path, opening: np.ndarray, text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message) as error:
        load_part(written(tmp_path, block(opening, radius=40.0), text))
    assert "\n" not in str(error.value)


def test_an_open_mesh_is_refused(tmp_path: Path) -> None:
    mesh = block(octagon(10.8))
    with pytest.raises(UsageError, match="not watertight"):
        load_part(written(tmp_path, TriangleMesh(mesh.vertices, mesh.faces[1:])))


def test_a_block_that_is_too_large_for_the_grid_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"is 0\.2\d* x .* at most 0\.256 m long; .*cut off"):
        load_part(written(tmp_path, block(octagon(10.8), radius=150.0)))
