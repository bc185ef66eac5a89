"""COLLADA meshes of URDF files: units, nodes, polygons, several geometries, damaged files."""

from pathlib import Path

import numpy as np
import pytest
from tests.sim.scene.test_urdf import robot

from gelflow.errors import UsageError
from gelflow.sim.scene import load_scene
from gelflow.sim.scene.geometry.collada import read_collada

pytestmark = pytest.mark.filterwarnings("ignore:the matrix subclass")  # of NumPy, used by pycollada
CORNERS = np.array([[x, y, z] for x in (0, 2) for y in (0, 1) for z in (0, 3)], dtype=float)  # of a box
SIDES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]  # outwards
TRIANGLES = [corner for a, b, c, d in SIDES for corner in (a, b, c, a, c, d)]
POLYLIST = f"""<polylist count="6" material="none"><input semantic="VERTEX" source="#v" offset="0"/>
  <vcount>4 4 4 4 4 4</vcount><p>{" ".join(str(i) for side in SIDES for i in side)}</p></polylist>"""
TRIANGLE_LIST = f"""<triangles count="12"><input semantic="VERTEX" source="#v" offset="0"/>
  <p>{" ".join(map(str, TRIANGLES))}</p></triangles>"""
LINES = '<lines count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1</p></lines>'
NODE = '<node id="n"><matrix>0 -1 0 10  1 0 0 20  0 0 1 30  0 0 0 1</matrix><instance_geometry url="#g"/></node>'


def collada(path: Path, primitives: str, *, nodes: str = NODE, unit: float = 0.01) -> Path:
    values = " ".join(map(str, CORNERS.reshape(-1)))
    path.write_text(
        f"""<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
 <asset><created>2020-01-01T00:00:00Z</created><modified>2020-01-01T00:00:00Z</modified>
  <unit name="centimeter" meter="{unit}"/><up_axis>Y_UP</up_axis></asset>
 <library_geometries><geometry id="g" name="box"><mesh>
  <source id="s"><float_array id="a" count="24">{values}</float_array><technique_common>
   <accessor source="#a" count="8" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
    <param name="Z" type="float"/></accessor></technique_common></source>
  <vertices id="v"><input semantic="POSITION" source="#s"/></vertices>{primitives}</mesh></geometry>
 </library_geometries>
 <library_visual_scenes><visual_scene id="scene">{nodes}</visual_scene></library_visual_scenes>
 <scene><instance_visual_scene url="#scene"/></scene>
</COLLADA>"""
    )
    return path


@pytest.mark.parametrize("primitives", [POLYLIST, TRIANGLE_LIST, LINES + TRIANGLE_LIST])
def test_triangles_are_placed_and_in_metres(primitives: str, tmp_path: Path) -> None:
    mesh = read_collada(collada(tmp_path / "box.dae", primitives))
    placed = CORNERS @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]] + [10, 20, 30]
    np.testing.assert_allclose(np.unique(mesh.vertices[mesh.faces], axis=None), np.unique(0.01 * placed), atol=1e-7)
    assert mesh.volume() == pytest.approx(6e-6, rel=1e-6)


def test_each_node_places_its_geometry(tmp_path: Path) -> None:
    other = NODE.replace('id="n"', 'id="m"').replace("10", "-10")
    mesh = read_collada(collada(tmp_path / "box.dae", TRIANGLE_LIST, nodes=NODE + other))
    assert len(mesh.faces) == 24 and mesh.volume() == pytest.approx(12e-6, rel=1e-6)
    assert mesh.vertices[:, 0].min() == pytest.approx(-0.11) and mesh.vertices[:, 0].max() == pytest.approx(0.1)


@pytest.mark.parametrize("address", ["box.dae", "meshes/box.dae", "package://arm/meshes/box.DAE"])
def test_urdf_with_a_collada_mesh(address: str, tmp_path: Path) -> None:
    file = tmp_path / "arm" / address.removeprefix("package://arm/")
    file.parent.mkdir(parents=True, exist_ok=True)
    collada(file, POLYLIST)
    scene = load_scene(robot(tmp_path / "arm" / "arm.urdf", mesh=address))
    (geom,) = [geom for geom in scene.geoms if geom.kind == "mesh"]
    assert geom.mesh is not None
    assert geom.mesh.volume() == pytest.approx(6e-6, rel=1e-5)
    at = geom.pose.apply(geom.mesh.vertices)
    np.testing.assert_allclose(at.min(axis=0), [0.09, 0.2, 0.3], atol=1e-6)
    np.testing.assert_allclose(at.max(axis=0), [0.1, 0.22, 0.33], atol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "cannot read the mesh .*box.dae"),
        ("<COLLADA/>", "cannot read the mesh .*box.dae|has no triangles"),
        ("solid box", "cannot read the mesh .*box.dae"),
        (None, "has no triangles"),
    ],
)
def test_file_without_triangles_is_refused_in_one_line(text: str | None, message: str, tmp_path: Path) -> None:
    file = collada(tmp_path / "box.dae", LINES)
    if text is not None:
        file.write_text(text)
    with pytest.raises(UsageError, match=message) as caught:
        load_scene(robot(tmp_path / "arm.urdf", mesh="box.dae"))
    assert "\n" not in str(caught.value)
