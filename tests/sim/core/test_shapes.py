"""Distances and normals of shapes compared with independent formulas."""

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize

from gelflow.errors import UsageError
from gelflow.sim import _core
from gelflow.sim.simulator import Simulator

Array = NDArray[np.float64]

SIZES = {
    "sphere": (0.02, 0, 0),
    "box": (0.03, 0.02, 0.01),
    "cylinder": (0.02, 0.03, 0),
    "capsule": (0.015, 0.03, 0),
    "ellipsoid": (0.03, 0.02, 0.012),
}


def depth_and_normal(kind: str, points: Array) -> tuple[Array, Array]:
    """Depth (n,) and outward normal (n, 3) at points of a fixed shape, from markers of 1 N/m."""
    spec = _core.ModelSpec()
    spec.gravity = (0, 0, 0)
    body = spec.add_body(_core.BodyDef(name="probe", mass=1.0, inertia=(1, 1, 1, 0, 0, 0)))
    spec.add_joint(_core.JointDef(name="slide", body=body, type="slide", axis=(1, 0, 0)))
    shape = spec.add_shape(_core.ShapeDef(name="shape", kind=kind, size=SIZES[kind]))
    spec.add_pad(
        _core.PadDef(
            name="pad",
            body=body,
            positions=points,
            shapes=[shape],
            kn=1.0,
            kt=0.0,
            mu=0.0,
            kd=0.0,
        )
    )
    force = Simulator(_core.Model(spec)).tactile()[0] * [1, 1, -1]
    depth = np.linalg.norm(force, axis=1)
    return depth, force / np.maximum(depth, 1e-300)[:, None]


def outside_of_box(x: Array, half: Array) -> float:
    q = np.abs(x) - half
    return float(np.linalg.norm(np.maximum(q, 0)) + min(q.max(), 0.0))


def distance(kind: str, x: Array) -> float:
    """Signed distance by a formula independent of the core."""
    a, b, c = SIZES[kind]
    if kind == "sphere":
        return float(np.linalg.norm(x) - a)
    if kind == "box":
        return outside_of_box(x, np.array([a, b, c]))
    if kind == "cylinder":
        return outside_of_box(np.array([np.hypot(*x[:2]), x[2]]), np.array([a, b]))
    if kind == "capsule":
        return float(np.linalg.norm([x[0], x[1], max(abs(x[2]) - b, 0)]) - a)
    radii = np.array([a, b, c])

    def surface(angles: Array) -> Array:
        (ct, cp), (st, sp) = np.cos(angles), np.sin(angles)
        return np.array([radii[0] * ct * cp, radii[1] * st * cp, radii[2] * sp])

    x = np.abs(x)  # the nearest point is in the same octant
    starts = itertools.product((0.3, 1.2), repeat=2)
    near = min(np.linalg.norm(surface(minimize(lambda s: ((surface(s) - x) ** 2).sum() * 1e4, s0, tol=1e-14).x) - x)
               for s0 in starts)  # fmt: skip
    return float(near if (x**2 / radii**2).sum() > 1 else -near)


@pytest.mark.parametrize("kind", SIZES)
def test_depth_and_normal_equal_the_formulas(kind: str) -> None:
    rng = np.random.default_rng(1)
    reach = {"cylinder": (0.02, 0.02, 0.03), "capsule": (0.015, 0.015, 0.045)}.get(kind, SIZES[kind])
    points = rng.uniform(-1.1, 1.1, (40 if kind == "ellipsoid" else 400, 3)) * np.where(
        np.array(reach) > 0, reach, reach[0]
    )
    depth, normal = depth_and_normal(kind, points)
    expected = np.array([max(-distance(kind, x), 0.0) for x in points])
    assert 0.2 < (expected > 0).mean() < 1
    np.testing.assert_allclose(depth, expected, atol=2e-9 if kind == "ellipsoid" else 1e-15)
    # The point displaced by the depth along the normal is on the surface.
    inside = expected > 1e-6
    ends = points[inside] + normal[inside] * depth[inside, None] * (1 - 1e-9)
    assert depth_and_normal(kind, ends)[0].max() < 1e-10


@pytest.mark.parametrize("kind", SIZES)
def test_forces_are_finite_where_the_distance_has_no_gradient(kind: str) -> None:
    points = np.array([[0, 0, 0], [0, 0, 1e-3], [1e-3, 0, 0], [0, 1e-20, 0], [1e-3, 1e-3, 0]], dtype=float)
    depth, normal = depth_and_normal(kind, points)
    assert (depth > 0).all()
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-12)
    np.testing.assert_array_equal(normal, depth_and_normal(kind, points)[1])


@pytest.mark.parametrize(
    ("kind", "size", "message"),
    [
        ("cone", (1, 1, 1), "kind 'cone' is not one of plane, sphere, box, cylinder, capsule, ellipsoid"),
        ("ellipsoid", (0.1, 0.1, 0), "size must be positive"),
        ("capsule", (0.1, -0.1, 0), "size must be positive"),
    ],
)
def test_invalid_shape_raises(kind: str, size: tuple[float, float, float], message: str) -> None:
    with pytest.raises((UsageError, ValueError), match=message):
        _core.ModelSpec().add_shape(_core.ShapeDef(name="s", kind=kind, size=size))
