"""The latency monitor warns only of latency that is certain."""

import numpy as np
import pytest

from gelflow.perception.tracker import TrackerConfig
from gelflow.real.camera.latency import LatencyEstimate
from gelflow.real.runner.touch.grasp_latency import GraspSignals, LatencyMonitor


@pytest.mark.parametrize(
    ("factor", "low", "certain"),
    [
        pytest.param(1.0, 0.004, False, id="within the tolerance"),
        pytest.param(1.0, 0.006, True, id="beyond it"),
        pytest.param(6.0, 0.020, False, id="delays of this computer at six times real time"),
        pytest.param(6.0, 0.044, True, id="more than these"),
    ],
)
def test_latency_is_reported_when_its_lower_bound_exceeds_the_tolerance(
    factor: float, low: float, certain: bool
) -> None:
    monitor = LatencyMonitor(("left", "right"), [TrackerConfig()] * 2, clock_factor=factor)
    monitor.estimates[1].append(LatencyEstimate(low, low + 0.076))
    assert monitor.excess == pytest.approx(low if certain else 0.0)
    assert [line.split(":")[0] for line in monitor.warnings()] == (["right camera"] if certain else [])


def test_grasp_without_measured_force_gives_no_estimate() -> None:
    config = [TrackerConfig()] * 2
    assert GraspSignals().latencies(config) == [None, None]
    assert GraspSignals(force=[(0.0, float(np.nan)), (0.04, float(np.nan))]).latencies(config) == [None, None]
