"""The recordings that the tests of the calibration share."""

import pytest
from tests.policies.calibration.recorded_world import WORLD

from gelflow.policies.calibration.experiment.worlds import RecordedWorld, record_world


@pytest.fixture(scope="package")
def world() -> RecordedWorld:
    return record_world(WORLD)
