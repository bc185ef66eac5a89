"""Parts that are meshes: mass, outline, grasped sides, symmetry, contact points, insertions and errors."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from tests.sim.tasks.parts.harness import both_depths, make_attempts

from gelflow.errors import UsageError
from gelflow.part import CUBOID, Part
from gelflow.sim.scene.geometry.mesh import TriangleMesh
from gelflow.sim.tasks.insertion import insertion_scene
from gelflow.sim.tasks.parts import load_part, part_geometry, shipped_mesh, with_part
from gelflow.sim.tasks.parts.mesh_part import MeshPart, found_symmetry, grasped_sides
from gelflow.sim.tasks.parts.mesh_picture import picture
from gelflow.sim.tasks.parts.shipped_meshes import connector, hexagon, obj_text, prism
from gelflow.task import InsertionTask

PART = """format = 1
[part]
shape = "mesh"
file = "part.obj"
scale = 0.001
[hole]
clearance = 0.002
[grasp]
height = [-0.003, 0.007]
"""
BOX = np.array([[-10, -15], [10, -15], [10, 15], [-10, 15]], dtype=float)


def written(tmp_path: Path, mesh: TriangleMesh, text: str = PART) -> Path:
    (tmp_path / "part.obj").write_text(obj_text(mesh))
    (tmp_path / "part.toml").write_text(text)
    return tmp_path / "part.toml"


def test_mesh_of_a_shipped_part_is_found_by_its_digest() -> None:
    described = Part.from_json(load_part("connector").part.to_json())
    assert not described.mesh_file
    mesh = shipped_mesh(described)
    assert mesh is not None
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx(described.size)
    assert shipped_mesh(dataclasses.replace(described, mesh="0" * 64)) is None
    assert shipped_mesh(CUBOID) is None


def test_the_meshes_that_come_along_are_those_of_the_script() -> None:
    folder = Path(load_part("hexagon").part.mesh_file).parent
    for name, mesh in (("hexagon", hexagon()), ("connector", connector())):
        assert (folder / f"{name}.obj").read_text() == obj_text(mesh)


def test_a_box_as_a_mesh_equals_the_box(tmp_path: Path) -> None:
    task = load_part(written(tmp_path, prism(BOX + np.array([3, -2]), 60.0)))
    part = task.part
    np.testing.assert_allclose(part.size, [0.02, 0.03, 0.06], atol=1e-9)
    assert part.grasp_width == pytest.approx(0.02)
    assert (part.symmetry, set(part.mirror)) == (2, {"x", "y"})
    box = dataclasses.replace(part, shape="box", mesh="", mesh_file="")
    mesh_body, box_body = (
        next(body for body in with_part(insertion_scene(), p).bodies if body.name == "part") for p in (part, box)
    )
    assert mesh_body.mass == pytest.approx(box_body.mass)
    np.testing.assert_allclose(mesh_body.com, 0, atol=1e-9)
    np.testing.assert_allclose(mesh_body.inertia, box_body.inertia, atol=1e-9 * box_body.inertia.max())
    points = np.random.default_rng(0).uniform(-0.02, 0.02, (300, 2))
    theirs = part_geometry(box).hole.distance(points)
    inside = theirs < 0
    np.testing.assert_allclose(part_geometry(part).hole.distance(points)[inside], theirs[inside], atol=0.06e-3)


def test_the_symmetry_of_the_parts_that_come_along_is_found() -> None:
    hexagonal, plug = load_part("hexagon").part, load_part("connector").part
    assert (hexagonal.symmetry, hexagonal.mirror) == (6, ("x", "y"))
    assert (plug.symmetry, plug.mirror) == (1, ())


def test_a_fine_cylinder_is_round_and_a_half_moon_has_one_mirror_axis() -> None:
    angle = 2 * np.pi * np.arange(64) / 64
    circle = 10e-3 * np.column_stack([np.cos(angle), np.sin(angle)])
    mesh = prism(circle, 40e-3)
    assert found_symmetry(mesh, "round") == (0, ("x", "y"))
    half = circle[:33] - [0, 5e-3]
    assert found_symmetry(prism(half, 40e-3), "half") == (1, ("x",))


def test_a_file_may_give_the_symmetry(tmp_path: Path) -> None:
    text = PART + "[symmetry]\nrotations = 1\nmirror = []\n"
    part = load_part(written(tmp_path, prism(BOX, 60.0), text)).part
    assert (part.symmetry, part.mirror) == (1, ())


def test_a_symmetry_that_the_mesh_does_not_have_is_refused(tmp_path: Path) -> None:
    for rotations, message in ((0, "not round"), (5, "not equal after 1/5 of a turn")):
        with pytest.raises(UsageError, match=rf"symmetry: the mesh is {message}.*gap beside the part is 1 mm"):
            load_part(written(tmp_path, prism(BOX, 60.0), f"{PART}[symmetry]\nrotations = {rotations}\n"))
    assert load_part(written(tmp_path, prism(BOX, 60.0), f"{PART}[symmetry]\nrotations = 1\n")).part.symmetry == 1


def test_all_multiples_of_a_rotation_must_fit(tmp_path: Path) -> None:
    """A part without symmetry turned by 5° fits as well, but not when it is turned again and again."""
    text = PART + "[symmetry]\nrotations = {}\n"
    for rotations, message in ((36, "not equal after 1/36 of a turn"), (1000, "rotations must be at most 72")):
        with pytest.raises(UsageError, match=message):
            load_part(written(tmp_path, prism(BOX, 60.0), text.format(rotations)))
    circle = 15 * np.column_stack([np.cos(np.arange(72) * np.pi / 36), np.sin(np.arange(72) * np.pi / 36)])
    assert load_part(written(tmp_path, prism(circle, 60.0), text.format(72))).part.symmetry == 72


def test_the_order_of_mirror_axes_has_no_meaning(tmp_path: Path) -> None:
    parts = [load_part(written(tmp_path, prism(BOX, 60.0), f"{PART}[symmetry]\nmirror = {axes}\n")).part
             for axes in ('["x", "y"]', '["y", "x"]')]  # fmt: skip
    assert parts[0] == parts[1]


@pytest.mark.parametrize(
    ("changed", "name"), [({"clearance": (1.0, 1.0)}, "clearance"), ({"size": (0.03, 5.0, 0.06)}, "size")]
)
def test_lengths_in_another_unit_are_refused(changed: dict[str, tuple[float, ...]], name: str) -> None:
    with pytest.raises(UsageError, match=rf"{name} may be at most .* lengths are in metres"):
        dataclasses.replace(CUBOID, **changed)  # type: ignore[arg-type]


def test_pads_meet_the_outermost_sides_at_their_height(tmp_path: Path) -> None:
    """A wedge that widens to the top: only the sides where the pads are count."""
    mesh = prism(BOX * 1e-3, 60e-3)
    upper = mesh.vertices[:, 2] > 0.03
    vertices = mesh.vertices - [0, 0, 0.03]
    vertices[upper, 0] += np.where(vertices[upper, 0] > 0, 6e-3, 0.0)
    left, right = grasped_sides(TriangleMesh(vertices, mesh.faces), (0.0, 0.0))
    assert left == pytest.approx(-0.01)
    assert right == pytest.approx(0.01 + 6e-3 * 48 / 60, abs=0.1e-3)


def test_a_picture_has_the_heights_of_the_mesh() -> None:
    below = picture(prism(BOX * 1e-3, 60e-3), along=2, pixel=0.1e-3)
    solid = ~np.isnan(below.low)
    assert solid.sum() * below.pixel**2 == pytest.approx(20e-3 * 30e-3, rel=0.01)
    assert below.low[solid].max() == 0
    np.testing.assert_allclose(below.high[solid], 60e-3)


def test_the_mass_of_the_hexagon() -> None:
    part = load_part("hexagon").part
    area = 2 * np.sqrt(3) * 0.012**2
    assert part_geometry(part).mass == pytest.approx(area * 0.06 * 1500, rel=1e-5)


@both_depths
@pytest.mark.parametrize("name", ["hexagon", "connector"])
def test_the_oracle_inserts_and_misaligned_parts_are_not_inserted(name: str, deep: bool) -> None:
    task = load_part(name)
    attempts = make_attempts(4, task, deep=deep)
    rng = np.random.default_rng(0)
    starts = np.array([[0, 0, 0], [3e-3, 0, 0], [0, -3e-3, 0], [0, 0, np.radians(10)]])
    attempts.draw(rng, misalignment=starts)
    result = attempts.attempt(rng)
    assert result.inserted[:3].tolist() == [True, False, False]
    assert not result.failed.any()
    assert (result.height[1:3] > task.success_height).all()


def test_an_open_mesh_is_refused_with_the_number_of_open_edges(tmp_path: Path) -> None:
    mesh = prism(BOX, 60.0)
    path = written(tmp_path, TriangleMesh(mesh.vertices, mesh.faces[1:]))
    with pytest.raises(UsageError, match="not watertight: 3 of its") as error:
        load_part(path)
    assert str(path) in str(error.value)


def test_a_mesh_in_millimetres_without_its_scale_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, prism(BOX, 60.0))
    for scale in ("", "scale = 0.1"):
        path.write_text(PART.replace("scale = 0.001", scale))
        with pytest.raises(UsageError, match=r"part.obj' is [\d.]+ x [\d.]+ x [\d.]+ m, .* 0\.001 for millimetres"):
            load_part(path)


def test_a_missing_mesh_and_a_changed_one_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path, prism(BOX, 60.0))
    task = load_part(path)
    (tmp_path / "part.obj").write_text(obj_text(prism(BOX * 1.1, 60.0)))
    with pytest.raises(UsageError, match="has changed"):
        part_geometry(task.part)
    (tmp_path / "part.obj").unlink()
    with pytest.raises(UsageError, match="no such mesh file"):
        load_part(path)


def test_a_description_has_no_mesh_and_says_so(tmp_path: Path) -> None:
    task = load_part(written(tmp_path, prism(BOX, 60.0)))
    copied = InsertionTask.from_json(task.to_json())
    assert copied == task and copied.digest() == task.digest()
    with pytest.raises(UsageError, match="give its part file"):
        MeshPart(copied.part)
