"""A world with a gel file: the markers move with an elastic layer that carries the forces of the pads."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from tests.hardware_mocks.simulated_cell.harness import grasped

from gelflow.clock import ScaledClock
from gelflow.errors import UsageError
from gelflow.gel.gel_file import ElasticGel, save_gel
from gelflow.hardware_mocks.simulated_cell.cell import SimulatedCell, SimulatedCellConfig, preset_config
from gelflow.hardware_mocks.simulated_cell.world import Gels, SensorEffects, World, load_world, training_world
from gelflow.perception.force.estimator import ForceEstimate, ForceEstimator
from gelflow.sim.tasks.parts import load_part

GEL = ElasticGel(3e5, 0.48, 3e-3)
WEIGHT = 0.063 * 9.8  # of the part [N]


@pytest.fixture
def world(tmp_path: Path) -> World:
    save_gel(GEL, tmp_path / "gel.toml")
    return World(gels=Gels(right=2.0, file=str(tmp_path / "gel.toml")))


def estimated(cell: SimulatedCell, finger: int) -> ForceEstimate:
    gel = cell.config.world.true_gel(finger)
    assert gel is not None
    moved = cell.marker_displacement(finger)
    force = ForceEstimator(gel, cell.config.grid).estimate(1e-3 * moved, np.ones(len(moved), dtype=bool))
    assert force is not None
    return force


def test_forces_of_the_markers_are_those_of_the_pads(world: World) -> None:
    cell = grasped(SimulatedCellConfig(seed=3, world=world))
    cell.advance(200)
    true = np.array(cell.truth()["pad_forces"])
    # The grip presses both pads alike, and they share the weight.
    np.testing.assert_allclose(true[:, 2], cell.gripper_state()[2], rtol=0.05)
    assert true[:, 0].sum() == pytest.approx(WEIGHT, rel=0.05)
    for finger in (0, 1):
        force = estimated(cell, finger)
        assert force.shear[0] == pytest.approx(true[finger, 0], abs=0.05)
        assert abs(force.shear[1] - true[finger, 1]) < 0.05
        assert force.normal == pytest.approx(true[finger, 2], rel=0.1)


def test_a_part_that_covers_a_strip_of_the_pads_is_measured_too(world: World) -> None:
    task = load_part("peg")
    made = dataclasses.replace(training_world(task.part), gels=world.gels)
    cell = SimulatedCell(ScaledClock(), preset_config(None, seed=3, world=made, task=task))
    cell.advance(100)
    cell.command_gripper(width=task.part.grasp_width - 3e-3, speed=0.1, force=12.0)
    cell.advance(300)
    for finger, (x, _, normal) in enumerate(cell.truth()["pad_forces"]):
        force = estimated(cell, finger)
        assert normal == pytest.approx(12.0, rel=0.05)
        assert force.normal == pytest.approx(normal, rel=0.1)
        assert force.shear[0] == pytest.approx(x, abs=0.05)


def test_a_gel_file_is_relative_to_the_world_file(tmp_path: Path) -> None:
    save_gel(ElasticGel(3e5, 0.48, 3e-3, creep=0.2, creep_time=0.3, friction=0.4), tmp_path / "gel.toml")
    path = tmp_path / "world.toml"
    path.write_text('format = 1\n[gels]\nright = 2\nfile = "gel.toml"\n[friction]\npads = 0.9\n')
    world = load_world(path)
    assert world.gels.file == str(tmp_path / "gel.toml")
    assert world.sensor_effects == SensorEffects(creep=0.2, creep_time=0.3)
    assert world.true_gel(1) == ElasticGel(6e5, 0.48, 3e-3, creep=0.2, creep_time=0.3, friction=0.9)
    assert World().true_gel(0) is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[gels]\nfile = "none.toml"', "gels: no such file"),
        ('[gels]\nfile = "creep.toml"\n[markers]\nrows = 40\ncols = 30', "at most 1000 markers, got 1200"),
        ('[gels]\nfile = "creep.toml"\n[sensor]\ncreep = 0.1', "creep is in [sensor] and in the gel file"),
    ],
)
def test_a_wrong_gel_file_is_refused_with_the_place(tmp_path: Path, text: str, message: str) -> None:
    save_gel(ElasticGel(3e5, 0.48, 3e-3, creep=0.2), tmp_path / "creep.toml")
    path = tmp_path / "world.toml"
    path.write_text(text)
    with pytest.raises(UsageError) as error:
        load_world(path)
    assert message in str(error.value) and str(path) in str(error.value) and "\n" not in str(error.value)
