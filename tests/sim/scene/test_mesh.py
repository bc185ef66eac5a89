"""Meshes in scenes: distance grids and their cache, rounding, contact points, and bodies at rest on meshes."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gelflow.errors import UsageError
from gelflow.sim.benchmark.describe import describe
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.scene.geometry.distance_grid import build_grid, cache_folder, distance_grid
from gelflow.sim.scene.geometry.mesh import TriangleMesh, closed_mesh, signed_distances
from gelflow.sim.scene.geometry.sampling import mesh_surface
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation import reference_meshes as mesh_solids

Array = NDArray[np.float64]

HALF = (0.03, 0.02, 0.01)
BRACKET = (0.04, 0.012, 0.02)  # arm, thickness, depth

MODEL = """
<mujoco>
  <asset><mesh name="table" file="table.obj" scale="2 2 2"/><mesh name="part" file="part.obj"/></asset>
  <worldbody>
    <geom name="table" type="mesh" mesh="table" pos="0.1 0.2 -0.02" euler="0 0 90"/>
    <body name="part" pos="0.1 0.2 0.011">
      <freejoint name="part"/><geom name="part" type="mesh" mesh="part" mass="0.05"/>
    </body>
  </worldbody>
</mujoco>
"""
SCENE = """
format = 1
model = "s.xml"
step = 0.005
[shapes.table]
resolution = 20
[points.part]
geom = "part"
count = 120
[contacts.rest]
points = "part"
against = "table"
kn = 500.0
kt = 1.0
mu = 0.5
kd = 100.0
"""


def write(folder: Path, toml: str = SCENE, xml: str = MODEL, table: TriangleMesh | None = None) -> Path:
    (folder / "s.xml").write_text(xml)
    (folder / "s.toml").write_text(toml)
    (folder / "table.obj").write_text(mesh_solids.obj(table or mesh_solids.box(HALF)))
    (folder / "part.obj").write_text(mesh_solids.obj(mesh_solids.box((0.01, 0.01, 0.01))))
    return folder / "s.toml"


def error_of(path: Path) -> str:
    with pytest.raises(UsageError) as caught:
        load_scene(path)
    text = str(caught.value)
    assert "\n" not in text
    return text


def at_rest(scene: Scene) -> Simulator:
    sim = Simulator(scene)
    sim.step(np.zeros((1, 0)), 400)
    sim.check()
    return sim


def test_mesh_at_rest_on_a_mesh(tmp_path: Path) -> None:
    """The table is scaled by 2, translated and rotated; the part is on its top face at z = 0."""
    scene = load_scene(write(tmp_path))
    sim = at_rest(scene)
    np.testing.assert_allclose(sim.wrenches()[0, 0, 3:], [0, 0, 0.05 * 9.81], atol=1e-3)
    depth = 0.05 * 9.81 / (500 * 20)  # about 20 of 120 points are on the lower face
    assert sim.q[0, 2] == pytest.approx(0.01 - depth, abs=depth)
    np.testing.assert_allclose(sim.q[0, :2], [0.1, 0.2], atol=2e-3)
    # The table supports it up to its edges, which the rotation put at y ± 60 mm and x ± 40 mm.
    for position, supported in (((0.13, 0.2), True), ((0.1, 0.25), True), ((0.155, 0.2), False), ((0.1, 0.275), False)):
        sim.reset()
        sim.q[0, :3] = (*position, 0.0099)
        assert (sim.wrenches()[0, 0, 5] > 1e-3) == supported


def test_forces_of_two_sided_mesh_contact_sum_to_the_weight(tmp_path: Path) -> None:
    toml = SCENE.replace("kn = 500.0", "kn = 250.0") + (
        '[shapes.part]\nresolution = 16\n[points.table]\ngeom = "table"\ncount = 2000\n'
        '[contacts.back]\npoints = "table"\nagainst = "part"\nkn = 250.0\nkt = 1.0\nmu = 0.5\nkd = 100.0\n'
    )
    sim = at_rest(load_scene(write(tmp_path, toml)))
    on_part, on_table = sim.wrenches()[0, :, 5]
    assert on_part > 0.05
    assert -on_table > 0.05
    assert on_part - on_table == pytest.approx(0.05 * 9.81, abs=1e-3)


def test_invalid_cache_files_are_rebuilt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GELFLOW_CACHE", str(tmp_path / "cache" / "grids"))
    mesh = mesh_solids.box(HALF)
    built = distance_grid(mesh, "m", resolution=8)
    (file,) = cache_folder().iterdir()
    with np.load(file) as arrays:
        cached = dict(arrays)
    np.savez(file, **{**cached, "origin": cached["origin"] + 1})
    assert distance_grid(mesh, "m", resolution=8).origin[0] == built.origin[0] + 1  # read from the cache
    corrupt = [b"", file.read_bytes()[:300], b"x" * 2000]
    for content in corrupt:
        file.write_bytes(content)
        np.testing.assert_array_equal(distance_grid(mesh, "m", resolution=8).coefficients, built.coefficients)
    for wrong in ({"format": 2}, {"coefficients": cached["coefficients"][0]}, {"spacing": -1.0}):
        np.savez(file, **{**cached, **wrong})
        again = distance_grid(mesh, "m", resolution=8)
        np.testing.assert_array_equal(again.coefficients, built.coefficients)
    for other in (
        distance_grid(mesh, "m", resolution=9),
        distance_grid(mesh_solids.box((0.03, 0.02, 0.011)), "m", resolution=8),
    ):
        assert (
            other.coefficients.shape != built.coefficients.shape or not (other.coefficients == built.coefficients).all()
        )
    assert len(list(cache_folder().iterdir())) == 3


def test_grid_is_built_without_a_writable_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("GELFLOW_CACHE", str(tmp_path / "file"))
    assert distance_grid(mesh_solids.box(HALF), "m", resolution=8).cells == (14, 12, 9)


def test_error_without_libigl_says_what_to_install(tmp_path: Path) -> None:
    path = write(tmp_path)
    code = (
        "import sys\nsys.modules['igl'] = None\nfrom gelflow.sim.scene import load_scene\n"
        f"try:\n    load_scene({str(path)!r})\nexcept Exception as error:\n    print(type(error).__name__, error)"
    )
    env = {**os.environ, "GELFLOW_CACHE": str(tmp_path / "none")}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    assert re.fullmatch(r"UsageError .*shapes\.table: mesh 'table': .* pip install libigl\n", done.stdout)
    load_scene(path)  # writes the cache; libigl is not needed afterwards
    env["GELFLOW_CACHE"] = os.environ["GELFLOW_CACHE"]
    assert subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True).stdout == ""


def box_with_faces(faces: NDArray[np.int64]) -> TriangleMesh:
    return TriangleMesh(mesh_solids.box(HALF).vertices, faces)


def test_open_or_inverted_mesh_is_an_error() -> None:
    box = mesh_solids.box(HALF)
    cases = {
        "mesh 'm' is not watertight: 3 of its 18 edges belong to one triangle only": box.faces[1:],
        "mesh 'm' is not watertight: at 3 of its 18 edges": np.concatenate([box.faces[:1, ::-1], box.faces[1:]]),
        "mesh 'm' is inside out": box.faces[:, ::-1],
    }
    for message, faces in cases.items():
        with pytest.raises(UsageError, match=re.escape(message)):
            build_grid(box_with_faces(faces), "m", resolution=8)
    # Triangles with separate vertices, as in an STL file, are the same mesh.
    separate = TriangleMesh(box.vertices[box.faces.reshape(-1)], np.arange(box.faces.size).reshape(-1, 3))
    assert closed_mesh(separate, "m").volume() == pytest.approx(8 * np.prod(HALF))
    assert len(closed_mesh(separate, "m").vertices) == 8


def test_unresolved_geometry_is_an_error() -> None:
    box = mesh_solids.box(HALF)
    moved = TriangleMesh(
        np.concatenate([box.vertices, box.vertices + 0.004]), np.concatenate([box.faces, box.faces + 8])
    )
    with pytest.raises(UsageError, match="its parts overlap"):
        build_grid(moved, "m", resolution=8)
    with pytest.raises(UsageError, match=r"thinner than the cells of 0\.0075 m"):
        build_grid(mesh_solids.box((0.03, 0.02, 0.001)), "m", resolution=8)
    with pytest.raises(UsageError, match="resolution must be from 4 to 512 cells, got 600"):
        distance_grid(box, "m", resolution=600)
    with pytest.raises(UsageError, match=r"below 2 cells of 0\.0075 m; set resolution = 40 or more"):
        build_grid(box, "m", resolution=8, rounding=0.003)
    with pytest.raises(UsageError, match="removes the whole mesh"):
        build_grid(box, "m", resolution=16, rounding=0.012)


INVALID_SHAPES = [
    (
        "[shapes.table]\nresolution = 20",
        "[shapes.tabel]\nresolution = 20",
        "no geometry 'tabel'; did you mean 'table'?",
    ),
    ("resolution = 20", "resolutoin = 20", "shapes.table: unknown key 'resolutoin'; did you mean 'resolution'?"),
    ("resolution = 20", "resolution = 3", "shapes.table: resolution must be an integer ≥ 4"),
    ("resolution = 20", "resolution = 20\nrounding = -1", "shapes.table: rounding must be a finite number ≥ 0"),
    ("resolution = 20", "resolution = 20\nrounding = 0.004", "shapes.table: mesh 'table': a rounding of 0.004 m"),
    ("count = 120", 'count = 120\nfaces = "+z"', "points.part: unknown key 'faces'"),
    ("count = 120", "count = 20001", "points.part: a mesh needs a count of 1 to 20000, got 20001"),
]


@pytest.mark.parametrize(("old", "new", "message"), INVALID_SHAPES, ids=[message for *_, message in INVALID_SHAPES])
def test_invalid_shape_options_give_a_one_line_error(old: str, new: str, message: str, tmp_path: Path) -> None:
    assert old in SCENE
    assert message in error_of(write(tmp_path, SCENE.replace(old, new)))


def test_error_of_an_open_mesh_names_the_geometry(tmp_path: Path) -> None:
    box = mesh_solids.box(HALF)
    path = write(tmp_path, table=TriangleMesh(box.vertices, box.faces[1:]))
    assert "s.toml, shapes.table: mesh 'table' is not watertight: 3 of its 18 edges" in error_of(path)


def test_boxes_and_cylinders_with_rounded_edges(tmp_path: Path) -> None:
    for kind, size, least in (("box", "0.06 0.04 0.02", 0.02), ("cylinder", "0.05 0.02", 0.02)):
        xml = MODEL.replace('type="mesh" mesh="table"', f'type="{kind}" size="{size}"')
        rounded = write(tmp_path, SCENE.replace("resolution = 20", "rounding = 0.003"), xml)
        scene = load_scene(rounded)
        assert scene.shapes[0].rounding == 0.003
        assert "table.rounding" in scene.build().param_names
        assert at_rest(scene).wrenches()[0, 0, 5] == pytest.approx(0.05 * 9.81, abs=1e-3)
        write(tmp_path, SCENE.replace("resolution = 20", f"rounding = {least}"), xml)
        assert f"rounding must be below the smallest half size, {least:g} m" in error_of(tmp_path / "s.toml")
        write(tmp_path, SCENE, xml)
        assert "unknown key 'resolution'" in error_of(tmp_path / "s.toml")
    xml = MODEL.replace('type="mesh" mesh="table"', 'type="sphere" size="0.1"')
    write(tmp_path, SCENE.replace("resolution = 20", "rounding = 0.003"), xml)
    assert "a sphere has no options; box, cylinder, mesh have" in error_of(tmp_path / "s.toml")


def test_rounded_mesh_is_exact_at_the_nodes() -> None:
    """The spline of a rounded box mesh against the closed form of the rounded box, at the nodes of the grid."""
    rounding, spacing = 0.006, 0.06 / 32
    grid = build_grid(mesh_solids.box(HALF), "m", resolution=32, rounding=rounding)
    nodes = grid.origin + spacing * np.argwhere(np.ones(np.array(grid.cells) + 1))
    beyond = np.abs(nodes) - (np.array(HALF) - rounding)
    exact = np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(1), 0) - rounding
    # Values of the spline at its nodes, from its coefficients.
    values = grid.coefficients.astype(float)
    for axis in range(3):
        v = np.moveaxis(values, axis, 0)
        values = np.moveaxis((v[:-2] + 4 * v[1:-1] + v[2:]) / 6, 0, axis)
    np.testing.assert_allclose(values.reshape(-1), exact, atol=2e-9)  # single precision


def test_distances_to_a_bracket_are_exact() -> None:
    points = np.random.default_rng(0).uniform(-0.02, 0.06, (20_000, 3))
    mesh = closed_mesh(mesh_solids.bracket(*BRACKET), "m")
    distances, nearest = signed_distances(mesh, points, "m")
    np.testing.assert_allclose(distances, mesh_solids.bracket_distance(points, *BRACKET), atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(points - nearest, axis=1), np.abs(distances), atol=1e-15)


@pytest.mark.parametrize("count", [1, 50, 700])
def test_points_on_a_mesh_are_nearly_uniform_and_sum_to_its_area(count: int) -> None:
    mesh = mesh_solids.bracket(*BRACKET)
    points, components = mesh_surface(mesh, count=count)
    areas = components.sum(1)
    total = float(mesh.areas_and_normals()[0].sum())
    assert points.shape == (count, 3)
    assert areas.sum() == pytest.approx(total, rel=1e-12)
    np.testing.assert_allclose(mesh_solids.bracket_distance(points, *BRACKET), 0, atol=1e-12)
    again = mesh_surface(mesh, count=count)
    np.testing.assert_array_equal(points, again[0])
    np.testing.assert_array_equal(components, again[1])
    # Area of the faces with normals along x, y, z.
    arm, thick, depth = BRACKET
    faces = [2 * arm * depth, 2 * arm * depth, 2 * (2 * arm - thick) * thick]
    np.testing.assert_allclose(components.sum(0), faces, rtol=2e-3)
    if count > 1:
        assert areas.min() > 0.3 * total / count
        assert areas.max() < 2 * total / count
        gaps = cKDTree(points).query(points, k=2)[0][:, 1] / np.sqrt(total / count)
        assert gaps.min() > 0.25


def test_both_sides_of_a_sheet_are_sampled() -> None:
    half = (0.03, 0.03, 1e-4)
    points, components = mesh_surface(mesh_solids.box(half), count=200)
    areas = components.sum(1)
    side = 4 * half[0] * half[1]
    for sign in (-1, 1):
        assert areas[points[:, 2] * sign > 0.99e-4].sum() == pytest.approx(side, rel=0.03)
    # The first moments of the area of a centred sheet are 0.
    assert np.abs(areas @ points).max() < 5e-3 * areas.sum() * half[0]


def test_describe_shows_the_grid(tmp_path: Path) -> None:
    scene = load_scene(write(tmp_path))
    (shape,) = describe(scene).shapes
    assert (shape.name, shape.kind, shape.rounding) == ("table", "mesh", 0.0)
    assert sorted(shape.cells or ()) == [13, 20, 26]  # MuJoCo rotates a mesh to its principal axes
    assert shape.spacing == pytest.approx(0.12 / 20)
    grid = scene.shapes[0].grid
    assert grid is not None
    assert shape.bytes == grid.nbytes == 29 * 23 * 16 * 4 + 26 * 20 * 13
