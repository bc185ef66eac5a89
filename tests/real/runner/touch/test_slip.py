"""Slip in the grip, from the arm's motion and the shear of the pads."""

import numpy as np
import pytest

from gelflow.real.runner.touch.slip import SlipMonitor


def descend(shear_at: "dict[float, float]", *, scale: float = 1.0) -> SlipMonitor:
    """Descend in steps of 17 µm with the shear interpolated between these depths [mm] → [mm]."""
    monitor = SlipMonitor(0.04 * scale)
    depths, shears = zip(*sorted(shear_at.items()), strict=True)
    for depth in np.arange(0.0, depths[-1], 0.017):
        if monitor.add(1e-3 * depth, scale * float(np.interp(depth, depths, shears))):
            break
    return monitor


@pytest.mark.parametrize("scale", [1.0, 0.2])
def test_elastic_contact_is_no_slip(scale: float) -> None:
    monitor = descend({0.0: 0.0, 0.5: 0.0, 1.1: 0.4}, scale=scale)
    assert not monitor.slipped and monitor.distance == 0.0


@pytest.mark.parametrize("scale", [1.0, 0.2])
def test_constant_shear_while_the_arm_moves_is_slip(scale: float) -> None:
    monitor = descend({0.0: 0.0, 0.5: 0.0, 0.65: 0.1, 1.1: 0.1}, scale=scale)
    assert monitor.slipped
    assert 0.15e-3 <= monitor.distance < 0.3e-3  # it is found within 0.2 mm


def test_motion_without_contact_is_no_slip() -> None:
    assert not descend({0.0: 0.01, 1.1: 0.01}).slipped


@pytest.mark.parametrize("slope", [0.3, 0.1, 0.02])  # of the shear [mm/mm]; the weight of the part shears by 0.06 mm
def test_slow_even_growth_with_a_soft_arm_is_no_slip(slope: float) -> None:
    assert not descend({0.0: 0.0, 0.5: 0.0, 4.1: 3.6 * slope}).slipped


@pytest.mark.parametrize("slope", [0.3, 0.1, 0.03])
def test_slip_is_detected_with_a_soft_arm(slope: float) -> None:
    begin = 0.5 + 0.06 / slope
    monitor = descend({0.0: 0.0, 0.5: 0.0, begin: 0.06, 4.1: 0.06})
    assert monitor.slipped
    assert monitor.distance < 1e-3 * (begin - 0.5 - 0.04 / slope + 0.2)  # it is found within 0.2 mm
