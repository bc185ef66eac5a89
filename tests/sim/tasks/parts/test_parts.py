"""Parts of one's own: part files, the scene with a part and its hole, the grasp, and insertions."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from tests.sim.tasks.parts.harness import both_depths, make_attempts, with_published_descent

from gelflow.errors import UsageError
from gelflow.part import CUBOID, Part
from gelflow.sim.tasks.insertion import InsertionAttempts, insertion_scene
from gelflow.sim.tasks.insertion_randomization import NOMINAL
from gelflow.sim.tasks.parts import load_part, part_geometry, part_names, with_part
from gelflow.sim.tasks.parts.grasp import indentation, pad_gaps
from gelflow.sim.tasks.parts.outline import Circle, Outline, Polygons, Rectangle, hole_grid
from gelflow.task import INSERTION, InsertionTask, insertion_task

PEG = load_part("peg")
ROD = '[part]\nshape = "cylinder"\ndiameter = 0.02\nheight = 0.05\n[hole]\nclearance = 1e-3\n'


def poses(*millimetres: tuple[float, float]) -> np.ndarray:
    return np.array([[x * 1e-3, y * 1e-3, 0.0] for x, y in millimetres])


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "part.toml"
    path.write_text("format = 1\n" + text)
    return path


def test_the_part_file_of_the_cuboid_is_the_default_task() -> None:
    assert load_part("cuboid") == INSERTION
    assert "part" not in INSERTION.to_json()
    assert INSERTION.digest() == "cceede46a985d44f"


def test_a_task_with_a_part_survives_json_and_differs_in_its_digest() -> None:
    assert InsertionTask.from_json(PEG.to_json()) == PEG
    assert PEG.digest() != INSERTION.digest()
    wider = insertion_task(dataclasses.replace(PEG.part, clearance=(2e-3, 2e-3)))
    assert wider.digest() != PEG.digest()


def test_the_place_of_a_mesh_is_not_part_of_a_description() -> None:
    here, there = (dataclasses.replace(CUBOID, mesh_file=folder) for folder in ("a.stl", "b.stl"))
    assert here == there == CUBOID
    assert here.to_json() == there.to_json()


def test_a_box_of_the_same_size_gives_the_scene_of_the_cuboid() -> None:
    scene = insertion_scene()
    other = with_part(scene, dataclasses.replace(CUBOID, name="block"))
    assert with_part(scene, CUBOID) is scene
    for mine, theirs in zip(other.bodies, scene.bodies, strict=True):
        assert mine.mass == theirs.mass
        np.testing.assert_allclose(mine.inertia, theirs.inertia, rtol=1e-14)
    for shape, its in zip(other.shapes, scene.shapes, strict=True):
        np.testing.assert_array_equal(shape.size, its.size)
        np.testing.assert_array_equal(shape.pose.position, its.pose.position)
    for points, its_points in zip(other.points, scene.points, strict=True):
        np.testing.assert_array_equal(points.points, its_points.points)
    np.testing.assert_array_equal(other.q0, scene.q0)


@pytest.mark.parametrize(
    "hole",
    [
        Rectangle((0.02, 0.03)),
        Circle(0.0105),
        Polygons((np.array([[-0.01, -0.01], [0.012, -0.01], [0.0, 0.015]]),), offset=5e-4),
    ],
)
def test_the_distance_grid_of_a_hole_agrees_with_its_outline(hole: Outline) -> None:
    """In the plane halfway down; near edges the grid is exact to a small part of a cell."""
    grid = hole_grid(hole, 25e-3, 0.5e-3)
    index = np.array(grid.cells) // 2
    rng = np.random.default_rng(0)
    at = rng.uniform(-0.012, 0.012, (200, 2))
    from scipy.ndimage import map_coordinates

    u = (np.column_stack([at, np.full(200, 12e-3)]) - grid.origin) / grid.spacing + 1  # one node before the first cell
    found = map_coordinates(grid.coefficients.astype(float), u.T, order=3, prefilter=False)
    expected = -hole.distance(at)
    near = np.abs(expected) < 9e-3
    assert index.min() > 10
    np.testing.assert_allclose(found[near], expected[near], atol=0.12e-3)
    assert np.median(np.abs(found[near] - expected[near])) < 0.01e-3


def test_a_polygon_has_the_distances_of_its_rectangle_inside_and_rounds_its_corners_outside() -> None:
    box = Rectangle((0.01, 0.02))
    corners = np.array([[-0.01, -0.02], [0.01, -0.02], [0.01, 0.02], [-0.01, 0.02]])
    polygon = Polygons((corners,))
    inside = np.random.default_rng(0).uniform(-1, 1, (100, 2)) * [0.01, 0.02]
    np.testing.assert_allclose(polygon.distance(inside), box.distance(inside), atol=1e-15)
    assert polygon.distance(np.array([0.013, 0.024])) == pytest.approx(5e-3)
    assert polygon.enlarged((1e-3, 1e-3)).distance(np.array([0.013, 0.024])) == pytest.approx(4e-3)


def test_the_mass_and_inertia_of_a_cylinder() -> None:
    body = next(b for b in with_part(insertion_scene(), PEG.part).bodies if b.name == "part")
    mass = np.pi * 0.01**2 * 0.06 * 2700
    assert body.mass == pytest.approx(mass)
    np.testing.assert_allclose(body.inertia[2], mass * 0.01**2 / 2)
    np.testing.assert_allclose(body.inertia[:2], mass * (3 * 0.01**2 + 0.06**2) / 12)


def test_pads_indent_until_they_carry_the_grasp_force() -> None:
    scene = insertion_scene(PEG)
    gaps = pad_gaps(scene, part_geometry(PEG.part), "pad_left", np.array([0.0, 5e-3]))
    force, stiffness = np.array([4.0, 12.0]), np.array([8e3, 3e3])
    depth = indentation(gaps, force, stiffness)
    carried = stiffness * np.maximum(depth[:, None] - gaps, 0).sum(1)
    np.testing.assert_allclose(carried, force, rtol=1e-12)


@both_depths
def test_a_round_peg_is_inserted_where_its_outline_fits(deep: bool) -> None:
    attempts = make_attempts(6, PEG, deep=deep)
    rng = np.random.default_rng(0)
    attempts.draw(rng, misalignment=poses((0, 0), (0.4, 0), (0, -0.4), (1.0, 0), (0.8, -0.8), (4, 3)))
    held = attempts.sim.q[:, attempts.scene.q("part")]
    np.testing.assert_allclose(held[:, :2], 0, atol=2e-5)  # in the middle of the gripper
    result = attempts.attempt(rng)
    assert result.inserted.tolist() == [True] * 3 + [False] * 3
    assert not result.failed.any()
    assert (result.height[3:] > PEG.success_height).all()
    assert np.abs(result.image[5]).max() > 0.3


def test_the_oracle_inserts_pegs_under_randomized_physics() -> None:
    attempts = InsertionAttempts(32, task=PEG, threads=1)
    rng = np.random.default_rng(1)
    attempts.draw(rng, misalignment=np.zeros((32, 3)))
    # One of some hundred pegs rubs on the wall at the end of its descent, which counts as contact.
    assert attempts.attempt(rng).inserted.sum() >= 31
    limits = vars(attempts.randomization["grasp_height"].distribution)
    assert (limits["low"], limits["high"]) == PEG.part.grasp_height


def test_yaw_errors_follow_from_the_symmetry() -> None:
    yaw = np.radians([0, 10, 35, -70, 170])
    hexagon = dataclasses.replace(CUBOID, symmetry=6)
    np.testing.assert_allclose(np.degrees(hexagon.yaw_error(yaw)), [0, 10, -25, -10, -10], atol=1e-12)
    np.testing.assert_array_equal(PEG.part.yaw_error(yaw), 0)
    np.testing.assert_array_equal(CUBOID.yaw_error(yaw[:3]), yaw[:3])
    turned = np.array([[1e-3, 0, 0.2]])
    assert PEG.reward(turned) == pytest.approx(-0.01)
    assert PEG.misalignment[2] == 0  # a round part has no yaw, but the gripper may turn it
    assert PEG.correction(np.array([0, 0, 1]))[2] == pytest.approx(2 * PEG.workspace[2])


@both_depths
def test_a_box_may_have_another_size_mass_and_hole(tmp_path: Path, deep: bool) -> None:
    text = """
    [part]
    shape = "box"
    size = [0.02, 0.03, 0.05]
    mass = 0.08
    [hole]
    clearance = [0.002, 0.003]
    depth = 0.015
    [misalignment]
    x = 0.003
    yaw_deg = 5.0
    """
    task = load_part(written(tmp_path, text))
    assert task.part.name == "part"
    assert task.misalignment == pytest.approx((0.003, 0.006, np.radians(5)))
    assert (task.start_height, task.rim_height, task.success_height) == (15.5e-3, 15e-3, 14.7e-3)
    attempts = make_attempts(4, task, deep=deep)
    rng = np.random.default_rng(0)
    attempts.draw(rng, misalignment=poses((0, 0), (0.9, 1.4), (1.3, 0), (0, 1.8)))
    body = next(b for b in attempts.scene.bodies if b.name == "part")
    assert body.mass == pytest.approx(0.08)
    result = attempts.attempt(rng)
    assert result.inserted.tolist() == [True, True, False, False]
    np.testing.assert_allclose(result.height[:2], 11.4e-3 if deep else 14.4e-3, atol=6e-5)


def test_a_part_file_sets_the_depth_of_a_descent(tmp_path: Path) -> None:
    assert PEG.descent == 4.1e-3 and PEG.frame_depths == (4.1e-3,)
    given = load_part(written(tmp_path, ROD + "[descent]\ndepth = 0.0011"))
    assert (given.descent, given.frame_depths) == (1.1e-3, (1.1e-3,))
    shallow = load_part(written(tmp_path, ROD + "depth = 0.002"))
    assert shallow.descent == 1.5e-3  # 1 mm above the floor


def test_a_soft_arm_presses_harder_in_a_deeper_descent() -> None:
    """A servo of 0.2 N/mm: the forces of the markers grow with the depth below the rim, from 0.6 to 3.6 mm."""
    soft = NOMINAL.replace(arm_stiffness=200.0)
    divisors = []
    for task in (with_published_descent(PEG), PEG):
        attempts = InsertionAttempts(2, task=task, randomization=soft, threads=1)
        rng = np.random.default_rng(0)
        attempts.draw(rng, misalignment=poses((4, 0), (0, 4)))
        result = attempts.attempt(rng)
        assert not result.inserted.any() and not result.failed.any()
        divisors.append(result.divisor)
    assert (divisors[1] > 4 * divisors[0]).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[part]\nshape = "ball"', "shape is 'ball'"),
        ('[part]\nshape = "box"\nsize = [0.02, 0.02, 0.04]', "clearance is missing"),
        ('[part]\nshape = "box"\nradius = 1', "unknown key 'radius'"),
        ('[part]\nshape = "cylinder"\ndiameter = 0.02\nheight = 0.05\nmass = 1\ndensity = 2\n[hole]\nclearance = 1e-3',
         "give either mass or density"),
        ('[part]\nshape = "cylinder"\ndiameter = 0.2\nheight = 0.05\n[hole]\nclearance = 1e-3', "0.2 m wide"),
        ('[part]\nshape = "cylinder"\ndiameter = 0.02\nheight = 0.05\n[hole]\nclearance = 0',
         "clearance must be above 0, got [0.0, 0.0]"),
        ('[part]\nshape = "cylinder"\ndiameter = 0.02\nheight = 0.05\nmass = 150\n[hole]\nclearance = 1e-3',
         "part: the part weighs 150 kg; the gripper holds at most 2.5 kg"),
        ('[part]\nshape = "cylinder"\ndiameter = 0.02\nheight = 0.05\n[hole]\nclearence = 1e-3\nsides = 2',
         "unknown key 'clearence'; did you mean 'clearance'?"),
        ('[part]\nshape = "cylinder"\ndiameter = 0.02\nheight = 0.05\n[hole]\nsides = 2',
         "valid names: clearance, depth, file, scale"),
        ('[part]\nshape = "cylinder"\ndiameter = 0.02\nheight = 0.05\n[hole]\nclearance = 1e-3\n[grasp]\n'
         "height = [-0.03, 0]", "within ±0.025 m"),
        ('[part]\nshape = "cylinder"\ndiameter = 0.02\nheight = 0.05\n[hole]\nclearance = 1e-3\n[misalignment]\nx = 1',
         "at most 0.015"),
        (ROD + "[descent]\ndepth = 0.0008", "must descend by more than 0.0008 m"),
        (ROD + "depth = 0.002\n[descent]\ndepth = 0.0025", "less than 0.0025 m, the floor of the hole"),
        (ROD + "[descent]\nmax_depth = 0.002", "unknown key 'max_depth'"),
    ],
)  # fmt: skip
def test_errors_of_a_part_file_name_the_file_and_the_key(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(UsageError) as error:
        load_part(path)
    assert message in str(error.value)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_an_unknown_name_lists_the_parts_that_come_along() -> None:
    assert {"cuboid", "peg"} <= set(part_names())
    with pytest.raises(UsageError, match="did you mean 'peg'"):
        load_part("pegg")


def test_a_part_refuses_values_that_no_gripper_has() -> None:
    with pytest.raises(UsageError, match="shape"):
        Part(shape="ball")
    with pytest.raises(UsageError, match="rim"):
        dataclasses.replace(CUBOID, depth=0.06)
    with pytest.raises(UsageError, match="unknown keys"):
        Part.from_json({"colour": "red"})
