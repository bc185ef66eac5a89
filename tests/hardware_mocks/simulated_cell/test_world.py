"""A world changes the physics, the images and the taught pose of the mock robot."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.hardware_mocks.simulated_cell.harness import PlanarPose, aligned_pose, go, grasped

from gelflow.errors import UsageError
from gelflow.geometry import Pose, yaw_quaternion
from gelflow.hardware_mocks.robot import MockRobotConfig
from gelflow.hardware_mocks.simulated_cell.cell import SimulatedCell, SimulatedCellConfig
from gelflow.hardware_mocks.simulated_cell.world import (
    ArmDynamics,
    CameraView,
    Friction,
    Gels,
    Hole,
    MarkerPrint,
    Part,
    TaughtError,
    World,
    load_world,
    plain_world,
    world_from_tables,
)
from gelflow.perception.camera_calibration import fit_calibration
from gelflow.perception.frames import CameraMount
from gelflow.perception.synthetic.appearance import GelAppearance
from gelflow.perception.synthetic.fast_renderer import FastGelRenderer
from gelflow.perception.synthetic.lens import Lens
from gelflow.perception.tracker import MarkerTracker


def gripped(world: World) -> SimulatedCell:
    return grasped(SimulatedCellConfig(seed=3, world=world))


def lower(cell: SimulatedCell, target: PlanarPose, height: float, *, steps: int) -> dict[str, Any]:
    """Move to a planar pose about the taught hole, the lower face at `height` [m] above it; returns the truth."""
    go(cell, target, height, steps=steps)
    cell.advance(20)
    part: dict[str, Any] = cell.truth()["part"]
    return part


def mean_shear(cell: SimulatedCell) -> float:
    return float(np.mean([cell.marker_displacement(finger)[:, 0].mean() for finger in (0, 1)]))


def shear_of_the_rim(world: World) -> tuple[float, dict[str, Any]]:
    """Mean displacement [mm] of the markers after the part was lowered to 24.4 mm above the taught hole."""
    cell = gripped(world)
    lower(cell, (0.0, 0.0, 0.0), 0.0255, steps=300)
    rest = mean_shear(cell)
    part = lower(cell, (0.0, 0.0, 0.0), 0.0244, steps=300)
    return mean_shear(cell) - rest, part


# The file


def test_world_file_changes_the_named_values_and_no_others(tmp_path: Path) -> None:
    path = tmp_path / "world.toml"
    path.write_text(
        "format = 1\n[friction]\npads = 0.6\n[gels]\nleft = 5\n[hole]\nclearance = [2e-3, 3e-3]\n"
        "[taught_error]\nz = -3e-3\nyaw_deg = 4\n[markers]\nrows = 12\ncols = 10\npitch_mm = 1.8\njitter_mm = 0.02\n"
        "[cameras]\nrate = 20\ntilt_deg = [8, 0]\n[right_camera]\nrate = 25\n[arm]\nlag = 0.02\n[part]\nmass = 0.1\n"
    )
    expected = World(
        friction=Friction(pads=0.6),
        gels=Gels(left=5.0),
        hole=Hole((2e-3, 3e-3)),
        taught_error=TaughtError(z=-3e-3, yaw_deg=4.0),
        markers=MarkerPrint(rows=12, cols=10, pitch_mm=1.8, jitter_mm=0.02),
        left_camera=CameraView(rate=20.0, tilt_deg=(8.0, 0.0)),
        right_camera=CameraView(rate=25.0, tilt_deg=(8.0, 0.0)),
        arm=ArmDynamics(lag=0.02),
        part=Part(mass=0.1),
    )
    assert load_world(path) == expected
    assert world_from_tables(plain_world(expected), "again") == expected
    assert plain_world(World()) == {"format": 1}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[frictions]\npads = 1", "unknown key 'frictions'; did you mean 'friction'?"),
        ("[friction]\npad = 1", "unknown key 'pad'; did you mean 'pads'?"),
        ("[friction]\nwalls = 1", "valid names: floor, hole, pads"),
        ("[gels]\nleft = 0", "left must be within 0.001 to 2500"),
        ("[hole]\nclearance = [0, 1e-3]", "clearance must be above 0"),
        ("[cameras]\nbarrel = 2", "barrel of a lens must be within"),
        ("[cameras]\nblur_px = -1", "blur of a gel appearance must be within"),
        ("[markers]\nrows = 1", "rows must be within 2 to 60"),
        ("[taught_error]\nz = nan", "z must be a finite number"),
        ("format = 2", "format must be 1"),
        ("[arm]\nlag = true", "lag must be a finite number"),
    ],
)
def test_a_wrong_world_file_is_refused_with_the_place(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "world.toml"
    path.write_text(text)
    with pytest.raises(UsageError) as error:
        load_world(path)
    assert message in str(error.value) and str(path) in str(error.value) and "\n" not in str(error.value)


# Physics


def test_a_hole_that_is_taught_too_low_pushes_the_part_through_the_grip() -> None:
    cell = gripped(World(taught_error=TaughtError(z=-3e-3)))
    part = lower(cell, (0.0, 0.0, 0.0), 0.0255, steps=300)  # the start of an attempt, 2.5 mm below the rim
    assert part["largest_push"] > 1e-3 and part["largest_vertical_slip"] > 0.8e-3
    assert part["largest_force"] > 15.0
    exact = gripped(World())
    part = lower(exact, (0.0, 0.0, 0.0), 0.0255, steps=300)
    assert part["largest_push"] < 0.1e-3 and part["largest_force"] == 0.0


def test_a_part_that_is_lowered_onto_the_floor_slips_in_the_grip() -> None:
    cell = gripped(World(taught_error=TaughtError(z=-6e-3), hole=Hole(stiffness=10.0)))
    pose = aligned_pose(cell.truth()["part"])
    lower(cell, (0.0, 0.0, 0.0), 0.033, steps=100)
    lower(cell, pose, 0.033, steps=400)
    assert cell.truth()["part"]["largest_force"] == 0.0
    part = lower(cell, pose, 0.002, steps=800)
    assert part["largest_vertical_slip"] > 3e-3 and part["largest_force"] > 15.0
    assert abs(part["height"]) < 0.5e-3


def test_misalignment_contains_the_error_of_the_taught_pose() -> None:
    exact, wrong = gripped(World()), gripped(World(taught_error=TaughtError(x=2e-3, yaw_deg=3.0)))
    x, y, yaw = exact.truth()["part"]["misalignment"]
    moved = Pose(np.array([x, y, 0.0]), yaw_quaternion(yaw)) @ TaughtError(x=2e-3, yaw_deg=3.0).pose
    assert wrong.truth()["part"]["misalignment"] == pytest.approx([*moved.position[:2], moved.yaw])
    pose = aligned_pose(wrong.truth()["part"])
    lower(wrong, pose, 0.0255, steps=400)
    assert lower(wrong, pose, 0.0240, steps=300)["inserted"]


def test_stiff_gels_move_the_markers_less_under_more_force() -> None:
    soft, soft_part = shear_of_the_rim(World())
    stiff, stiff_part = shear_of_the_rim(World(gels=Gels(5.0, 5.0)))
    assert abs(stiff) < 0.4 * abs(soft) and stiff_part["largest_force"] > 1.5 * soft_part["largest_force"]
    left, right = gripped(World(gels=Gels(left=1.0, right=5.0))).truth()["pads"]
    assert right > 3 * left  # both gels are displaced by the same part, so the stiffer one carries the weight


def test_slippery_pads_let_the_part_slip_further() -> None:
    _, rough = shear_of_the_rim(World(taught_error=TaughtError(z=-1e-3)))
    _, smooth = shear_of_the_rim(World(taught_error=TaughtError(z=-1e-3), friction=Friction(pads=0.15)))
    assert smooth["largest_slip"] > 1.3 * rough["largest_slip"]
    assert smooth["largest_force"] < 0.7 * rough["largest_force"]


def test_clearance_sets_the_opening_of_the_hole() -> None:
    for clearance, inserted in ((4.5e-3, True), (0.2e-3, False)):
        cell = gripped(World(hole=Hole((clearance, clearance))))
        x, y, yaw = aligned_pose(cell.truth()["part"])
        pose = (x + 1e-3, y, yaw)  # beside the centre by less than half of the wide clearance
        lower(cell, pose, 0.0255, steps=400)
        assert lower(cell, pose, 0.0240, steps=300)["inserted"] is inserted


def test_slip_after_a_stop_is_not_a_push() -> None:
    cell = gripped(World())
    lower(cell, (0.0, 0.0, 0.0), 0.0255, steps=300)
    pushes = []
    for height in (0.0250, 0.0247, 0.0244):  # with a stop after each
        part = lower(cell, (0.0, 0.0, 0.0), height, steps=100)
        pushes.append(part["largest_push"])
    assert max(pushes) < 0.7 * part["largest_slip"]
    assert part["slip_at_rest"] == pytest.approx(part["largest_slip"], rel=0.2)


# Images


def test_a_tilted_camera_with_a_lens_shows_the_markers_where_the_lens_maps_them() -> None:
    appearance = GelAppearance()
    lens = Lens((8.0, -5.0), barrel=0.06)
    tracker = MarkerTracker()
    tracker.start(FastGelRenderer(appearance, lens=lens).render(np.zeros((252, 2))), rows=18, cols=14)
    expected = lens.apply(appearance.to_pixels(appearance.positions_mm()), appearance)
    order = CameraMount().marker_order()
    assert np.abs(tracker.rest[order] - expected).max() < 0.1
    ideal = appearance.to_pixels(appearance.positions_mm())
    assert np.abs(expected - ideal).max() > 10  # [px]
    fit = fit_calibration(tracker.rest, np.ones(252, dtype=bool), rows=18, cols=14, spacing_mm=1.4, size=(320, 427))
    assert fit.residual_px < 0.1


def test_a_lens_that_folds_the_image_is_refused() -> None:
    with pytest.raises(UsageError, match="too strong"):
        Lens((25.0, 25.0), distance_mm=8.0, barrel=0.3).sources(GelAppearance())


def test_print_jitter_moves_the_markers_of_each_camera_differently() -> None:
    config = MockRobotConfig(cell=SimulatedCellConfig(world=World(markers=MarkerPrint(jitter_mm=0.05))))
    left, right = config.print_error(0), config.print_error(1)
    assert left.shape == (252, 2) and left.std() == pytest.approx(0.05, rel=0.15)
    assert not np.array_equal(left, right) and np.array_equal(left, config.print_error(0))
    assert not replace(config, cell=SimulatedCellConfig()).print_error(0).any()


def test_images_of_a_world_follow_its_cameras() -> None:
    world = World(left_camera=CameraView(pixels_per_mm=12.0, blur_px=2.0), markers=MarkerPrint(rows=10))
    config = MockRobotConfig(cell=SimulatedCellConfig(world=world), rotations=(90, 0))
    left, lens = config.view(0)
    assert (left.pixels_per_mm, left.blur, left.grid.rows, left.rotation) == (12.0, 2.0, 10, 90)
    assert (left.width, left.height) == (427, 320) and lens.ideal
    right, _ = config.view(1)
    assert (right.pixels_per_mm, right.rotation, right.seed) == (15.7, 0, 1)
    assert math.isclose(config.cell.grid.pitch, 1.4)
