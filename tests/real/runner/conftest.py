"""The running mock robot, for the insertion-runner tests."""

import socket
from collections.abc import Iterator

import pytest
from tests.real.runner.harness import FACTOR, free_port

from gelflow.hardware_mocks.robot import MockRobot, MockRobotConfig
from gelflow.hardware_mocks.simulated_cell.cell import SimulatedCellConfig


@pytest.fixture
def robot() -> Iterator[MockRobot]:
    config = MockRobotConfig(
        cell=SimulatedCellConfig(seed=2), egm_port=free_port(socket.SOCK_DGRAM), rotations=(90, 180)
    )
    with MockRobot(FACTOR, config) as running:
        yield running
