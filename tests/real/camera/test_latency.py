"""Latency of a camera from a grasp: the true value is in the interval, which is as wide as the sampling periods."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.real.camera.latency import LatencyEstimate, combine_latencies, estimate_latency

RECORDED = Path(__file__).resolve().parents[2] / "data" / "mock_grasp.json"
Series = NDArray[np.float64]


def grasp(
    rng: np.random.Generator,
    latency: float,
    *,
    image_period: float = 1 / 30,
    state_period: float = 0.04,
    ramp: float = 0.05,
    noise: float = 0.01,
) -> tuple[Series, Series, Series, Series]:
    """Force and marker change of a grasp whose contact is 0.6 s after the start; the fingers have friction."""
    contact = 5.6 + rng.uniform(0, 0.1)
    state_times = 5.0 + rng.uniform(0, state_period) + np.arange(0, 1.2, state_period)
    force = np.maximum(np.where(state_times > 5.1, 0.5, 0.0), 12 * np.clip((state_times - contact) / ramp, 0, 1))
    exposed = 5.0 + rng.uniform(0, image_period) + np.arange(0, 1.2, image_period)
    moved = 0.3 * np.clip((exposed - contact) / (0.7 * ramp), 0, 1) * (1 + 0.3 * np.sin(90 * exposed))
    return state_times, force, exposed + latency, moved + np.abs(rng.normal(0, noise, exposed.size))


@pytest.mark.parametrize("latency", [0.0, 0.05, 0.15])
@pytest.mark.parametrize(("image_period", "state_period"), [(1 / 30, 0.04), (0.08, 0.02), (1 / 60, 0.1)])
def test_interval_contains_the_latency(latency: float, image_period: float, state_period: float) -> None:
    rng = np.random.default_rng(1)
    found = []
    for _ in range(200):
        series = grasp(rng, latency, image_period=image_period, state_period=state_period)
        found.append(estimate_latency(*series))
    known = [estimate for estimate in found if estimate is not None]
    assert len(known) == len(found)
    assert all(estimate.low - 1e-3 <= latency <= estimate.high + 1e-3 for estimate in known)
    assert np.median([estimate.uncertainty for estimate in known]) < 0.7 * (image_period + state_period)
    together = combine_latencies(known[:20])
    assert together is not None and abs(together.seconds - latency) < 0.01
    assert together.uncertainty < 0.5 * known[0].uncertainty


@pytest.mark.parametrize("noise", [0.001, 0.03])
@pytest.mark.parametrize("ramp", [0.005, 0.2])
def test_interval_contains_the_latency_with_noise_and_slow_contact(noise: float, ramp: float) -> None:
    rng = np.random.default_rng(3)
    found = [estimate_latency(*grasp(rng, 0.05, noise=noise, ramp=ramp)) for _ in range(200)]
    known = [estimate for estimate in found if estimate is not None]
    assert len(known) > 180
    outside = sum(not estimate.low <= 0.05 <= estimate.high for estimate in known)
    assert outside <= (4 if noise > 0.01 else 0)


def test_estimate_of_a_recorded_grasp_of_the_mock_robot_follows_a_delay() -> None:
    recorded: dict[str, Any] = json.loads(RECORDED.read_text())
    for sensor in ("left", "right"):
        times, change = np.array(recorded[sensor]["times"]), recorded[sensor]["change_px"]
        for delay in (0.0, 0.05, 0.12):  # the mock camera itself has no latency
            estimate = estimate_latency(recorded["force_times"], recorded["force"], times + delay, change)
            assert estimate is not None and estimate.low < delay < estimate.high
            assert estimate.uncertainty < 0.11  # two gripper states were received together just before the contact


@pytest.mark.parametrize("stall", [0.1, 0.5])
def test_samples_received_in_a_burst_widen_the_interval(stall: float) -> None:
    rng = np.random.default_rng(4)
    for _ in range(50):
        times, force, images, change = grasp(rng, 0.05)
        begin = 5.65 - stall * rng.uniform(0, 1)  # the gripper's receiver stands still about the contact
        late = np.where((times > begin) & (times < begin + stall), begin + stall, times)
        estimate = estimate_latency(late, force, images, change)
        assert estimate is not None and estimate.low - 1e-3 <= 0.05 <= estimate.high + 1e-3
        assert estimate.uncertainty < 0.06 + stall


def test_no_estimate_without_a_visible_grasp() -> None:
    rng = np.random.default_rng(2)
    times, force, images, change = grasp(rng, 0.0)
    assert estimate_latency(times, np.zeros_like(force), images, change) is None
    assert estimate_latency(times, force, images, rng.normal(0, 0.01, change.size)) is None
    assert estimate_latency(times, force, images, np.full_like(change, np.nan)) is None
    assert estimate_latency(times[:3], force[:3], images, change) is None
    assert estimate_latency(times[-8:], force[-8:], images, change) is None  # the series starts after the contact


def test_contradicting_estimates_give_none() -> None:
    first, second = LatencyEstimate(0.0, 0.03), LatencyEstimate(0.02, 0.06)
    assert combine_latencies([first, second]) == LatencyEstimate(0.02, 0.03)
    assert combine_latencies([first, LatencyEstimate(0.05, 0.09)]) is None
    assert combine_latencies([]) is None
    assert str(second) == "40 ± 20 ms"


def test_wrong_series_are_refused() -> None:
    with pytest.raises(UsageError, match="force: expected as many values"):
        estimate_latency([1, 2, 3, 4], [0, 0], [1, 2], [0, 0])
    with pytest.raises(UsageError, match=r"marker change.*ascending"):
        estimate_latency([1, 2, 3, 4], [0, 0, 0, 5], [1, 3, 2, 4], [0, 0, 0, 1])
