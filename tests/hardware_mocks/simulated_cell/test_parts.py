"""The simulated cell with a part of one's own."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from tests.hardware_mocks.simulated_cell.harness import aligned_pose, go

from gelflow.clock import ScaledClock
from gelflow.errors import UsageError
from gelflow.hardware_mocks.simulated_cell.cell import SimulatedCell, SimulatedCellConfig, preset_config
from gelflow.hardware_mocks.simulated_cell.world import Hole, World, load_world, training_world
from gelflow.session.records import from_plain, to_plain
from gelflow.sim.tasks.parts import load_part
from gelflow.task import INSERTION

PEG = load_part("peg")


def test_the_cell_of_the_cuboid_is_the_default() -> None:
    default, config = SimulatedCellConfig(), preset_config("fast", seed=0, task=INSERTION)
    for name in ("world", "grasp_height", "load_height", "start_width", "task"):
        assert getattr(config, name) == getattr(default, name)
    assert config.world == World()


def test_the_world_of_a_part_has_its_hole_and_mass(tmp_path: Path) -> None:
    world = training_world(PEG.part)
    assert world.hole.clearance == PEG.part.clearance
    assert world.part.mass == pytest.approx(np.pi * 0.01**2 * 0.06 * 2700)
    path = tmp_path / "world.toml"
    path.write_text("[part]\nmass = 0.1\n[hole]\nstiffness = 2.0\n")
    changed = load_world(path, PEG.part)
    assert (changed.part.mass, changed.hole.stiffness, changed.hole.clearance) == (0.1, 2.0, PEG.part.clearance)
    path.write_text("[hole]\nradius = 1.0\n")
    with pytest.raises(UsageError, match="unknown key 'radius'"):
        load_world(path, PEG.part)


def test_a_configuration_with_a_part_reaches_the_process_of_the_cell() -> None:
    config = preset_config("fast", seed=4, task=PEG)
    assert from_plain(SimulatedCellConfig, to_plain(config), what="cell").task == PEG


def test_a_world_cannot_change_the_clearance_of_a_hole_that_is_a_mesh() -> None:
    task = dataclasses.replace(PEG, part=dataclasses.replace(PEG.part, hole_mesh="0" * 64))
    config = dataclasses.replace(
        preset_config(None, seed=1, task=PEG), task=task, world=World(hole=Hole(clearance=(2e-3, 2e-3)))
    )
    with pytest.raises(UsageError, match="hole of this part is a mesh"):
        SimulatedCell(ScaledClock(), config)


def test_a_peg_is_grasped_shows_its_weight_and_is_inserted() -> None:
    config = preset_config(None, seed=1, task=PEG)
    cell = SimulatedCell(ScaledClock(), config)
    cell.advance(100)
    empty = cell.displacements().mean(axis=1)
    cell.command_gripper(width=0.017, speed=0.1, force=12.0)
    cell.advance(150)
    width, _, force = cell.gripper_state()
    assert cell.truth()["part"]["phase"] == "gripped"
    assert force == pytest.approx(12.0, rel=0.02) and width == pytest.approx(0.020, abs=0.8e-3)
    weight = cell.displacements().mean(axis=1) - empty
    assert (weight[:, 0] > 0.005).all()  # towards the fingertip, far above the noise of the tracker

    go(cell, (0.0, 0.0, 0.0), 0.0255, steps=400)
    rest = cell.displacements()
    go(cell, (0.0, 0.0, 0.0), 0.0248, steps=300)
    assert ((cell.displacements() - rest)[..., 0].mean(axis=1) < -0.01).all()  # the rim pushes up
    assert not cell.truth()["part"]["inserted"]

    go(cell, (0.0, 0.0, 0.0), 0.0255, steps=200)
    pose = aligned_pose(cell.truth()["part"])
    assert pose[2] == 0  # a gripper does not turn a round part
    go(cell, pose, 0.0255, steps=400)
    go(cell, pose, 0.0100, steps=600)
    truth = cell.truth()["part"]
    assert truth["inserted"] and truth["height"] < 0.0105
