"""Scenes that state no integrator turn gyroscopes and tumbling bodies as their closed forms do."""

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gelflow.geometry import rotate
from gelflow.sim import Simulator, load_scene
from gelflow.sim.scene import Scene, scene_names

STEP = 1e-3
DURATION = 2.0  # [s]
GRAVITY = 9.81
INERTIA = np.array([0.01, 0.02, 0.03])
SPIN = np.array([0.1, 6.0, -0.05])  # about the unstable intermediate axis


def scene(folder: Path, body: str, integrator: str | None) -> Scene:
    (folder / "s.xml").write_text(
        f'<mujoco><option timestep="{STEP}"/><worldbody><body name="body">{body}</body></worldbody></mujoco>'
    )
    (folder / "s.toml").write_text(f'format = 1\nmodel = "s.xml"\nstep = {STEP}\n')
    if integrator is None:
        assert load_scene(folder / "s.xml").integrator == load_scene(folder / "s.toml").integrator
        return load_scene(folder / "s.xml")
    return load_scene(folder / "s.toml", overrides={"integrator": integrator})


@pytest.mark.parametrize("integrator", [None, "bdf1"])
def test_gyroscope_precesses_at_a_constant_tilt(integrator: str | None, tmp_path: Path) -> None:
    """Regular precession of a heavy top: I₁ ψ̇² cos θ − I₃ ω₃ ψ̇ + m g l = 0."""
    mass, arm, across, along, spin, tilt = 0.5, 0.05, 4e-4, 7e-4, 100.0, np.radians(60)
    body = f'<joint type="ball"/><inertial pos="0 0 {arm}" mass="{mass}" diaginertia="{across} {across} {along}"/>'
    sim = Simulator(scene(tmp_path, body, integrator))
    rate = min(np.roots([(across + mass * arm**2) * np.cos(tilt), -along * spin, mass * GRAVITY * arm]))
    sim.q[0] = [np.cos(tilt / 2), np.sin(tilt / 2), 0, 0]
    sim.v[0] = [0, rate * np.sin(tilt), spin]
    sim.step(np.zeros(0), round(DURATION / STEP))
    sim.check()
    axis = np.array(rotate(sim.q[0], (0, 0, 1)))
    error = abs(np.degrees(np.arccos(axis[2]) - tilt))
    turned = np.arctan2(axis[0], -axis[1])  # from −y, towards +x
    late = abs(np.degrees((turned - rate * DURATION + np.pi) % (2 * np.pi) - np.pi))
    print(f"{integrator}: tilt off by {error:.3g}°, precession by {late:.3g}° of {np.degrees(rate * DURATION):.0f}°")
    if integrator is None:
        assert error < 0.5
        assert late < 6
    else:
        assert error > 5  # the reason for the default


@pytest.mark.parametrize("integrator", [None, "bdf1"])
def test_tumbling_body_keeps_its_energy(integrator: str | None, tmp_path: Path) -> None:
    inertia = " ".join(map(str, INERTIA))
    body = f'<freejoint/><inertial pos="0 0 0" mass="1" diaginertia="{inertia}"/>'
    start = scene(tmp_path, body, integrator)
    sim = Simulator(start)
    sim.param("gravity.z")[:] = 0
    sim.v[0, 3:] = SPIN
    sim.step(np.zeros(0), round(DURATION / STEP))
    sim.check()
    path = solve_ivp(
        lambda _, w: -np.cross(w, INERTIA * w) / INERTIA, (0, DURATION), SPIN, rtol=1e-12, atol=1e-12, dense_output=True
    )
    assert path.sol(np.linspace(0, DURATION, 200))[1].min() < -5  # it has flipped
    change = abs(INERTIA @ sim.v[0, 3:] ** 2 / (INERTIA @ SPIN**2) - 1)
    error = np.linalg.norm(sim.v[0, 3:] - path.y[:, -1]) / np.linalg.norm(SPIN)
    print(f"{integrator}: energy off by {change:.2g}, velocity by {error:.2g}")
    if integrator is None:
        assert change < 1e-5
        assert error < 5e-3
    else:
        assert change > 3e-3


@pytest.mark.parametrize("name", scene_names())
def test_shipped_scenes_state_their_integrator(name: str) -> None:
    """Policies were trained with it."""
    assert load_scene(name).integrator == "bdf1"
