"""Slip in the grip, from the arm's motion and the shear of the pads."""

import numpy as np
import pytest

from gelflow.real.runner.touch.slip import SlipMonitor


def descend(shear_at: "dict[float, float]", *, scale: float = 1.0) -> SlipMonitor:
    """Descend 1.1 mm in steps of 17 µm with the shear interpolated between these depths [mm] → [mm]."""
    monitor = SlipMonitor(0.04 * scale)
    depths, shears = zip(*sorted(shear_at.items()), strict=True)
    for depth in np.arange(0.0, 1.1, 0.017):
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
