"""Marker forces compared with eq. 8: grids of any shape, flat and curved pads, several shapes."""

from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.sim import _core
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.reference_motions import reference_motion

Array = NDArray[Any]
RADIUS, KN, KT, MU, KD = 0.02, 30.0, 0.4, 0.05, 2.0
CENTERS = np.array([[0.0, 0.0, 0.0], [0.009, 0.003, 0.0]])  # of two balls [m]
LIFT = (0.01995, 0.0180, 0.025)  # heights of the pad [m]: few, nearly all and no markers in contact
SPEED = np.array([0.02, -0.01, -0.03])


def pad_of(rows: int, cols: int, *, curved: bool) -> tuple[Array, Array, Array]:
    """Positions (n, 3), axes (n, 3, 3) in rows, and weights (n,) of markers on a pad of 8 mm, all different."""
    x, y = (0.008 * ((np.arange(n) + 0.5) / n - 0.5) for n in (rows, cols))
    places = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((rows, cols))], axis=-1).reshape(-1, 3)
    n = len(places)
    tilt = 0.2 * np.arange(n) / n if curved else np.zeros(n)
    c, s, zero, one = np.cos(tilt), np.sin(tilt), np.zeros(n), np.ones(n)
    axes = np.stack([np.stack(a, -1) for a in ((one, zero, zero), (zero, -c, s), (zero, -s, -c))], axis=1)
    return places, axes, 1 + np.arange(n) / n


def expected(places: Array, axes: Array, weights: Array, balls: int) -> Array:
    """Expected forces (n, 3) at world positions that move at SPEED."""
    total = np.zeros_like(places)
    for center in CENTERS[:balls]:
        away = places - center
        distance = np.linalg.norm(away, axis=1)
        normal, depth = away / distance[:, None], RADIUS - distance
        rate = normal @ SPEED
        push = np.maximum(KN - KD * rate, 0) * depth * weights
        wanted = -KT * weights[:, None] * (SPEED - rate[:, None] * normal)
        share = np.minimum(1, MU * push / np.linalg.norm(wanted, axis=1))
        total += np.where(depth[:, None] > 0, push[:, None] * normal + share[:, None] * wanted, 0)
    return np.asarray(np.einsum("nij,nj->ni", axes, total) * [1, 1, -1])


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("curved", [False, True])
@pytest.mark.parametrize("balls", [1, 2])
@pytest.mark.parametrize(("rows", "cols"), [(1, 3), (1, 4), (3, 4), (5, 7), (6, 8), (9, 12), (13, 10), (40, 36)])
def test_forces_equal_the_formula_for_every_marker(
    rows: int, cols: int, balls: int, curved: bool, precision: Literal["double", "single"]
) -> None:
    """In the order of the markers, for any previous contents of the array."""
    spec = _core.ModelSpec()
    body = spec.add_body(_core.BodyDef(name="pad", mass=0.1, inertia=(1e-5, 1e-5, 1e-5, 0, 0, 0)))
    for name, axis in zip("xyz", np.eye(3), strict=True):
        spec.add_joint(_core.JointDef(name=name, body=body, type="slide", axis=axis))
    shapes = [
        spec.add_shape(_core.ShapeDef(name=f"ball{i}", kind="sphere", pos=center, size=(RADIUS, 0, 0)))
        for i, center in enumerate(CENTERS[:balls])
    ]
    places, axes, weights = pad_of(rows, cols, curved=curved)
    numbers: dict[str, Any] = {"kn": KN, "kt": KT, "mu": MU, "kd": KD, "weights": weights.tolist()}
    spec.add_pad(
        _core.PadDef(
            name="pad",
            body=body,
            positions=places,
            axes=np.swapaxes(axes, 1, 2),
            shapes=shapes,
            **numbers,
        )
    )
    sim = Simulator(_core.Model(spec), precision=precision)
    sim.v[:] = SPEED
    touching = []
    for height in (*LIFT, *LIFT[::-1]):
        sim.q[0] = (0.001, 0.0, height)
        right = expected(places + sim.q[0], axes, weights, balls)
        size = max(float(np.abs(right).max()), 1e-3)
        allowed = (
            1e-12 * size if precision == "double" else 2e-5 * size + 2 * KN * 5e-9
        )  # positions have rounding errors of 5e-9 m
        np.testing.assert_allclose(sim.tactile(), right[None], rtol=0, atol=allowed)
        given = sim.tactile(np.full((1, len(places), 3), np.nan, sim.dtype))
        np.testing.assert_array_equal(given, sim.tactile())
        touching.append(float((right[:, 2] > 0).mean()))
    assert touching[2] == 0 and touching[1] > 0.5
    assert len(places) < 500 or 0 < touching[0] < 0.5


@pytest.mark.parametrize("side", [10, 60])
def test_own_array_equals_a_new_array(side: int) -> None:
    """Only entries of markers with present or previous contact are written: few, many and none here."""
    scene = load_scene("rolling", overrides={"pads.pad.rows": side, "pads.pad.cols": side})
    moves = reference_motion(scene)
    sim = Simulator(scene, num_envs=2, threads=1)
    sim.q[:] = moves.q0
    counts: set[int] = set()
    for block in np.array_split(moves.step_controls(scene.step), 40):
        for u in block:
            sim.step(u)
        sim.q[1] = moves.q0 + 1e-3 * len(counts)  # discontinuous state
        fresh = sim.tactile(np.full((2, side * side, 3), np.nan))
        own = sim.tactile()
        np.testing.assert_array_equal(own, fresh)
        counts.add(int((own[0, :, 2] > 0).sum()))
    assert len(counts) > 5
    with pytest.raises(ValueError, match="read-only"):
        own[0, 0] = 1.0


@pytest.mark.parametrize("weight", [-1.0, np.nan, np.inf])
def test_invalid_marker_weights_raise(weight: float) -> None:
    spec = _core.ModelSpec()
    shape = spec.add_shape(_core.ShapeDef(name="ball", kind="sphere", size=(RADIUS, 0, 0)))
    with pytest.raises(ValueError, match="pad 'pad': weights must be finite and not negative"):
        spec.add_pad(
            _core.PadDef(
                name="pad",
                body=-1,
                positions=[(0, 0, 0)],
                shapes=[shape],
                weights=[weight],
                kn=1,
                kt=0,
                mu=0,
                kd=0,
            )
        )
