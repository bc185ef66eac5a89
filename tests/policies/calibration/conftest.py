"""The recordings and the calibration that the tests of the calibration share."""

import numpy as np
import pytest
from tests.policies.calibration.recorded_world import LITTLE, WORLD

from gelflow.policies.calibration.calibration import Calibration, calibrate
from gelflow.policies.calibration.experiment.worlds import RecordedWorld, record_world


@pytest.fixture(scope="package")
def world() -> RecordedWorld:
    return record_world(WORLD)


@pytest.fixture(scope="package")
def calibrated(world: RecordedWorld) -> Calibration:
    return calibrate(world.recordings.of(np.array([0, 1])), settings=LITTLE)
