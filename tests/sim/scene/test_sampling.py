"""Sampled points are on the surface, and their weights sum to its area."""

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gelflow.errors import UsageError
from gelflow.sim.scene import load_scene
from gelflow.sim.scene.geometry import sampling
from gelflow.sim.scene.geometry.sampling import FACES, box_surface, capsule, cylinder, disc, ellipsoid


def test_rolling_pad_has_the_published_number_of_points() -> None:
    points, areas = box_surface((0.025, 0.025, 0.005), (20, 20, 20))
    assert len(points) == len(areas) == 20**3 - 18**3


@settings(deadline=None, max_examples=40)
@given(
    half=st.tuples(*[st.floats(0.01, 1.0)] * 3),
    resolution=st.tuples(*[st.integers(2, 6)] * 3),
    faces=st.lists(st.sampled_from(FACES), min_size=1, max_size=6, unique=True),
)
def test_box_weights_sum_to_the_area_of_the_faces(
    half: tuple[float, float, float], resolution: tuple[int, int, int], faces: list[str]
) -> None:
    points, areas = box_surface(half, resolution, faces=faces)
    area = {"x": 4 * half[1] * half[2], "y": 4 * half[0] * half[2], "z": 4 * half[0] * half[1]}
    assert areas.sum() == pytest.approx(sum(area[face[1]] for face in faces))
    assert (areas.sum(1) > 0).all()
    scaled = points / np.array(half)
    assert np.abs(scaled).max(axis=1) == pytest.approx(1)  # on the surface
    assert len(np.unique(points.round(9), axis=0)) == len(points)  # edges and corners occur once
    for face in faces:
        axis, sign = "xyz".index(face[1]), -1 if face[0] == "-" else 1
        on_face = np.isclose(scaled[:, axis], sign)
        others = [n for i, n in enumerate(resolution) if i != axis]
        assert on_face.sum() >= others[0] * others[1]


def test_box_points_include_the_corners() -> None:
    points, areas = box_surface((1.0, 2.0, 3.0), (2, 2, 2))
    assert sorted(map(tuple, points.tolist())) == sorted(
        (x, y, z) for x in (-1.0, 1.0) for y in (-2.0, 2.0) for z in (-3.0, 3.0)
    )
    assert areas == pytest.approx(np.tile([6.0, 3.0, 2.0], (8, 1)))  # a quarter of each adjacent face


def test_disc_has_the_published_number_of_points() -> None:
    points, areas = disc(0.018, 0.0015)
    assert len(points) == 66
    assert areas.sum() == pytest.approx(2 * np.pi * 0.018**2)
    assert np.linalg.norm(points[:, :2], axis=1).max() == pytest.approx(0.018)
    assert set(points[:, 2]) == {-0.0015, 0.0015}


def test_integrals_over_a_disc_converge() -> None:
    """∫ x² dA over a unit disc is π/4: the error is of second order in the spacing."""
    errors = []
    for radii in (4, 8, 16):
        points, areas = disc(1.0, 0.1, angles=16, radii=radii, faces=["+z"])
        errors.append(abs((areas[:, 2] * points[:, 0] ** 2).sum() - np.pi / 4))
    assert errors[0] > 1.7 * errors[1] > 1.7**2 * errors[2]


@settings(deadline=None, max_examples=40)
@given(
    angles=st.integers(3, 12),
    radii=st.integers(1, 4),
    heights=st.integers(2, 6),
    faces=st.lists(st.sampled_from(("-z", "+z", "wall")), min_size=1, max_size=3, unique=True),
)
def test_cylinder_weights_sum_to_the_area_of_the_faces(angles: int, radii: int, heights: int, faces: list[str]) -> None:
    radius, half = 0.3, 0.5
    points, areas = cylinder(radius, half, angles=angles, radii=radii, heights=heights, faces=faces)
    area = {"-z": np.pi * radius**2, "+z": np.pi * radius**2, "wall": 4 * np.pi * radius * half}
    assert areas.sum() == pytest.approx(sum(area[face] for face in faces))
    assert (areas.sum(1) > 0).all()
    assert len(np.unique(points.round(9), axis=0)) == len(points)  # points of the rims occur once
    around = np.linalg.norm(points[:, :2], axis=1)
    assert np.maximum(around / radius, np.abs(points[:, 2]) / half) == pytest.approx(1)  # on the surface
    flat = sum(area[face] for face in faces if face != "wall")
    assert areas.sum(0) == pytest.approx([area["wall"] / 2 * ("wall" in faces)] * 2 + [flat])
    # First moment of each face in z.
    expected = sum(area[face] * {"-z": -half, "+z": half, "wall": 0}[face] for face in faces)
    assert (areas.sum(1) * points[:, 2]).sum() == pytest.approx(expected, abs=1e-12)


HALVES = [("-z", "+z"), ("-z",), ("+z",)]


@pytest.mark.parametrize("faces", HALVES)
@pytest.mark.parametrize("half", [0.0, 0.4])
def test_spheres_and_capsules(half: float, faces: tuple[str, ...]) -> None:
    points, areas = capsule(0.2, half, count=200, faces=faces)
    assert len(points) == 200
    axis = np.clip(points[:, 2], -half, half)
    assert np.linalg.norm(points - np.stack([0 * axis, 0 * axis, axis], -1), axis=1) == pytest.approx(0.2)
    assert areas.sum() == pytest.approx(len(faces) / 2 * (4 * np.pi * 0.2**2 + 4 * np.pi * 0.2 * half))
    assert ((points[:, 2] < 0) == (len(faces) == 2) | (faces == ("-z",)))[points[:, 2] < 0].all()
    # Nearly uniform: nearest neighbours are not much closer than the spacing of a regular grid of equal areas.
    gaps = np.linalg.norm(points[:, None] - points, axis=-1) + np.eye(200)
    assert gaps.min() > 0.6 * np.sqrt(areas[0].sum())


@pytest.mark.parametrize("faces", HALVES)
@pytest.mark.parametrize("axes", [(0.1, 0.1, 0.1), (0.1, 0.2, 0.3), (0.3, 0.1, 0.1)])
def test_ellipsoids(axes: tuple[float, float, float], faces: tuple[str, ...]) -> None:
    """Area and ∫ z² dA against a dense quadrature over both angles."""
    u, v = np.meshgrid((np.arange(400) + 0.5) / 400 * np.pi, np.arange(400) / 400 * 2 * np.pi)
    direction = np.stack([np.sin(u) * np.cos(v), np.sin(u) * np.sin(v), np.cos(u)], axis=-1)
    cell = np.prod(axes) * np.linalg.norm(direction / axes, axis=-1) * np.sin(u) * np.pi / 400 * 2 * np.pi / 400
    points, areas = ellipsoid(axes, count=500, faces=faces)
    assert np.linalg.norm(points / axes, axis=1) == pytest.approx(1)
    assert areas.sum() == pytest.approx(cell.sum() * len(faces) / 2, rel=1e-4)
    z = (cell * (axes[2] * direction[..., 2]) ** 2).sum() * len(faces) / 2
    assert (areas.sum(1) * points[:, 2] ** 2).sum() == pytest.approx(z, rel=2e-3)
    assert (points[:, 2] < 0).any() == ("-z" in faces) and (points[:, 2] > 0).any() == ("+z" in faces)


@pytest.mark.parametrize("axes", [(0.1, 0.1, 0.1), (0.1, 0.2, 0.3)])
def test_area_components_give_the_derivative_of_the_area(axes: tuple[float, float, float]) -> None:
    """dA/ds of a scaling s along one axis is the sum of the components along the other two axes."""
    _, areas = ellipsoid(axes, count=400)
    for axis in range(3):
        stretch = np.ones(3)
        stretch[axis] = 1 + 1e-6
        larger = ellipsoid(tuple(np.array(axes) * stretch), count=400)[1].sum()
        others = areas.sum() - areas[:, axis].sum()
        assert (larger - areas.sum()) / 1e-6 == pytest.approx(others, rel=5e-3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: box_surface((1, 1, 1), (1, 2, 2)), "at least 2 points"),
        (lambda: box_surface((1, 1, 1), (2, 2, 2), faces=["z"]), "unknown face 'z'"),
        (lambda: box_surface((1, 1, 1), (2, 2, 2), faces=["-z", "-z"]), "each named once"),
        (lambda: disc(1, 1, angles=2), "at least 3 angles"),
        (lambda: disc(1, 1, faces=["-x"]), "faces of a disc must be some of -z, .z"),
        (lambda: cylinder(1, 1, faces=["-x"]), "faces of a cylinder must be some of -z, .z, wall, each named once"),
        (lambda: cylinder(1, 1, heights=1), "at least 3 angles and 2 heights, got 16 and 1"),
        (lambda: capsule(1, 1, count=0), "a capsule needs a count of at least 1, got 0"),
        (lambda: ellipsoid((1, 1, 1), count=9, faces=["wall"]), "faces of an ellipsoid must be some of -z, .z"),
    ],
)
def test_invalid_sampling_is_an_error(call: object, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        call()  # type: ignore[operator]


def test_many_points_are_announced() -> None:
    with pytest.raises(UsageError, match="box: 1000000000000 points do not fit into memory"):
        box_surface([1, 1, 1], [10_000, 10_000, 10_000])
    with pytest.warns(UserWarning, match="box: 1000002 points; each step"):
        box_surface([1, 1, 1], [2, 3, 166_667])
    with pytest.raises(UsageError, match="do not fit into memory"):
        load_scene("pushing", overrides={"pads.pad.rows": 100_000, "pads.pad.cols": 100_000})


SOLIDS = {
    "can": 'type="cylinder" size="1 1"',
    "pill": 'type="capsule" size="1 1"',
    "egg": 'type="ellipsoid" size="1 1 2"',
}


@pytest.mark.parametrize(
    ("table", "owner"),
    [
        ('[points.p]\ngeom = "can"\nangles = 100\nradii = 10', "points.p"),
        ('[points.p]\ngeom = "can"\nangles = 100\nheights = 10\nfaces = ["wall"]', "points.p"),
        ('[points.p]\ngeom = "pill"\ncount = 1000', "points.p"),
        ('[points.p]\ngeom = "egg"\ncount = 1000', "points.p"),
        ('PAD\nshape = "disc"\nradius = 0.01\ncount = 1000', "pads.pad"),
        ('PAD\nshape = "hemisphere"\nradius = 0.01\ncount = 1000', "pads.pad"),
        ('PAD\nshape = "points"\nfile = "markers.csv"', "pads.pad: markers.csv"),
        ('PAD\nshape = "points"\nfile = "markers.npz"', "pads.pad: markers.npz"),
    ],
)
def test_many_points_of_each_kind_are_announced(
    table: str, owner: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    geoms = "".join(f'<geom name="{name}" {solid} mass="1"/>' for name, solid in SOLIDS.items())
    (tmp_path / "s.xml").write_text(
        '<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/>'
        f'<body name="b"><freejoint/><site name="tip"/>{geoms}</body></worldbody></mujoco>'
    )
    positions = np.random.default_rng(0).normal(size=(1000, 3))
    np.savetxt(tmp_path / "markers.csv", positions, delimiter=",")
    np.savez_compressed(tmp_path / "markers.npz", positions=positions)
    law = "\nagainst = 'floor'\nkn = 1\nkt = 1\nmu = 1\nkd = 1\n"
    contact = f"\n[contacts.c]\npoints = 'p'{law}" if "points.p" in table else law
    text = 'format = 1\nmodel = "s.xml"\nstep = 1e-3\n' + table.replace("PAD", '[pads.pad]\nsite = "tip"') + contact
    (tmp_path / "s.toml").write_text(text)
    load_scene(tmp_path / "s.toml")
    monkeypatch.setattr(sampling, "MANY_POINTS", 900)
    with pytest.warns(UserWarning, match=re.escape(owner) + r": (1000|2000) points; each step"):
        load_scene(tmp_path / "s.toml")
    monkeypatch.setattr(sampling, "MOST_POINTS", 900)
    with pytest.raises(UsageError, match=re.escape(owner) + r": \d+ points do not fit into memory; at most 900"):
        load_scene(tmp_path / "s.toml")
