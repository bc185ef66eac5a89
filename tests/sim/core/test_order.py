"""Order of the integrators in smooth motion: halving the step halves the error of BDF1 and quarters that of BDF2."""

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim import _core
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator

Array = NDArray[np.float64]

TIME = 0.08  # [s]


def rolling(step: float, integrator: str) -> Simulator:
    scene = load_scene("rolling", friction="viscous", overrides={"step": step, "integrator": integrator})
    spec = scene.model_spec()
    spec.tolerance = 1e-13
    return Simulator(_core.Model(spec))


@pytest.fixture(scope="module")
def at_rest() -> Array:
    sim = rolling(5e-3, "bdf1")
    sim.step([0, 0, 0.2], 4_000)
    assert np.abs(sim.v).max() < 1e-14
    return sim.q.copy()


def end(start: Array, steps: int, integrator: str) -> Array:
    """State after a smooth push on the pad, which rests on the ball."""
    sim = rolling(TIME / steps, integrator)
    sim.q[:] = start
    for k in range(1, steps + 1):
        push = (1 - np.cos(2 * np.pi * k / steps)) / 2
        sim.step([2e-3 * push, 1e-3 * push, 0.2 + 2e-3 * push])
    sim.check()
    return np.concatenate([sim.q[0], sim.v[0]])


@pytest.mark.parametrize(("integrator", "order", "within"), [("bdf1", 1, 0.2), ("bdf2", 2, 0.3)])
def test_error_decreases_with_the_order_of_the_integrator(
    at_rest: Array, integrator: str, order: int, within: float
) -> None:
    exact = end(at_rest, 2048, "bdf2")
    errors = [np.abs(end(at_rest, steps, integrator) - exact).max() for steps in (16, 32, 64, 128, 256)]
    slopes = -np.diff(np.log2(errors))
    print(f"{integrator}: errors {[f'{e:.1e}' for e in errors]}, slopes {slopes.round(2)}")
    np.testing.assert_allclose(slopes, order, atol=within)


def test_error_of_free_flight_equals_its_closed_form() -> None:
    """The error is g h t / 2 for BDF1, and that of the first step for BDF2, which starts with BDF1."""
    heights = {}
    for integrator in ("bdf1", "bdf2"):
        sim = rolling(1e-3, integrator)
        ball = sim.joint_q("ball")
        sim.q[0, ball + 2] += 1.0
        sim.v[0, sim.joint_v("ball") + 2] = 0.5
        start = sim.q[0, ball + 2]
        sim.step([0, 0, -9.0], 100)
        heights[integrator] = sim.q[0, ball + 2] - (start + 0.5 * 0.1 - 9.8 * 0.1**2 / 2)
    assert abs(heights["bdf1"]) == pytest.approx(9.8 * 1e-3 * 0.1 / 2, rel=1e-3)
    assert abs(heights["bdf2"]) < 0.02 * abs(heights["bdf1"])


def test_bdf2_history_is_part_of_the_state(at_rest: Array) -> None:
    sim = rolling(5e-3, "bdf2")
    sim.q[:] = at_rest
    u = np.tile([1e-3, 0, 0.2], (6, 1, 1))
    whole = sim.rollout(u)
    again = sim.rollout(
        u[3:],
        q=whole.q[3],
        v=whole.v[3],
        anchors=whole.anchors[3],
        anchored=whole.anchored[3],
        history=whole.history[3],
    )
    np.testing.assert_array_equal(again.q[-1], whole.q[-1])
    assert whole.history[0, 0, -1] == 0 and whole.history[1, 0, -1] == 1
    sim.step(u[0, 0])
    sim.clear_history()
    assert not sim.history.any()
    assert rolling(5e-3, "bdf1").history.shape == (1, 0)


@pytest.mark.parametrize("integrator", ["bdf1", "bdf2"])
def test_error_estimate_of_a_step(at_rest: Array, integrator: str) -> None:
    """The estimate is of second order, like the local error of BDF1, and not smaller for BDF2."""
    estimates = []
    for step in (4e-3, 2e-3, 1e-3):
        sim = rolling(step, integrator)
        sim.q[:] = at_rest
        sim.step([0, 0, 0.2], 2)
        before = sim.q.copy()
        estimate = sim.error_estimate([2e-3, 1e-3, 0.202])
        np.testing.assert_array_equal(sim.q, before)
        assert estimate.shape == (1, sim.model.nv)
        estimates.append(np.abs(estimate).max())
    assert all(1.5 < np.log2(big / small) < 3 for big, small in itertools.pairwise(estimates))
    with pytest.raises(UsageError, match="not finite"):
        sim.error_estimate([np.nan, 0, 0])


def test_elastic_law_resolves_the_start_of_contact_to_one_step() -> None:
    """An anchor is set at the end of the step in which its point touches, so the shear lacks the displacement from the
    touch to this time. The error is of first order under BDF2 too. Where a step and its half have the same time left
    after the touch, halving does not change the error."""
    speed, fall, height = 0.2, 0.1, 1.039e-3
    touched, time = height / fall, 0.0256
    lacks = {}
    for step in (1.6e-3, 8e-4, 4e-4, 2e-4, 1e-4):
        spec = _core.ModelSpec()
        spec.gravity, spec.step, spec.integrator = (0.0, 0.0, 0.0), step, "bdf2"
        body = spec.add_body(_core.BodyDef(name="block", pos=(0, 0, height), mass=1e6, inertia=(1, 1, 1, 0, 0, 0)))
        for name, axis in zip("xz", ((1, 0, 0), (0, 0, 1)), strict=True):  # too heavy to be decelerated
            spec.add_joint(_core.JointDef(name=name, body=body, type="slide", axis=axis))
        plane = spec.add_shape(_core.ShapeDef(name="plane", kind="plane", size=(1, 1, 1)))
        spec.add_pad(
            _core.PadDef(
                name="pad",
                body=body,
                positions=[(0, 0, 0)],
                shapes=[plane],
                law="elastic",
                kn=1e3,
                kt=0,
                mu=1e6,
                kd=0,
                ks=1.0,
            )
        )
        sim = Simulator(_core.Model(spec))
        sim.v[0] = speed, -fall
        sim.step([], round(time / step))
        shear = -sim.tactile()[0, 0, 0]  # stiffness 1 N/m: equals a displacement
        lacks[step] = speed * (time - touched) - shear
        assert lacks[step] == pytest.approx(speed * (np.ceil(touched / step) * step - touched), abs=1e-9)
    assert lacks[4e-4] == pytest.approx(lacks[1e-4], abs=1e-9)  # contact is detected at 10.4 ms, after 10.39 ms
