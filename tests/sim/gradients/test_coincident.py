"""Exactly coincident geometry: a marker on an edge, coplanar faces, a pad that overhangs its body.

Lengths are powers of two, so that the geometry coincides exactly in single precision too.
"""

from itertools import product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.geometry import rotate
from gelflow.sim import _core
from gelflow.sim.scene import FRICTION_LAWS
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.gradient_check import RolloutLoss, compare_to_dual_numbers

Array = NDArray[np.float64]

UNIT = 2.0**-10  # [m]
PRECISIONS = ("double", "single")
ROUNDING = {"double": 1e-12, "single": 1e-5}
NUMBERS: dict[str, Any] = {"kn": 1024.0, "kt": 16.0, "mu": 0.5, "kd": 1024.0}  # UNIT deep: 1 N
SIZES = {"box": (16, 8, 8), "cylinder": (8, 16, 0)}  # [UNIT]
ON_EDGES = {"box": [(16, 0, 8), (16, 8, 4), (16, 8, 8)], "cylinder": [(8, 0, 16), (0, 8, -16)]}


def law_of(law: str) -> dict[str, Any]:
    return {**NUMBERS, "law": law, "ks": 512.0 if law == "elastic" else 0.0}


def marker(kind: str, at: tuple[float, float, float], law: str, precision: Any) -> Simulator:
    """One marker on three slides, at a position relative to a shape [UNIT]."""
    spec = _core.ModelSpec()
    spec.gravity = (0, 0, 0)
    body = spec.add_body(_core.BodyDef(name="hand", mass=0.25, inertia=(1e-3, 1e-3, 1e-3, 0, 0, 0)))
    for axis, name in zip(np.eye(3), "xyz", strict=True):
        spec.add_joint(_core.JointDef(name=name, body=body, type="slide", axis=axis))
    shape = spec.add_shape(_core.ShapeDef(name="shape", kind=kind, size=[UNIT * s for s in SIZES[kind]]))
    spec.add_pad(
        _core.PadDef(
            name="pad",
            body=body,
            positions=UNIT * np.array([at]),
            shapes=[shape],
            **law_of(law),
        )
    )
    return Simulator(_core.Model(spec), precision=precision)


def reading_by_q(sim: Simulator) -> tuple[Array, Array]:
    """World force of the marker, (3,), and its derivative with respect to the slides, (3, 3)."""
    run = sim.rollout(np.zeros((1, 1, 0)), read_after=[0])
    signs = np.array([1.0, 1.0, -1.0])
    rows = [sim.rollout_gradient(run, tactile=row).q[0] for row in np.diag(signs)]
    return run.tactile[0, 0, 0].astype(float) * signs, np.array(rows, float)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("law", FRICTION_LAWS)
@pytest.mark.parametrize("kind", SIZES)
def test_marker_on_an_edge_has_no_force(kind: str, law: str, precision: str) -> None:
    """Force and gradient are zero, as outside of the shape."""
    for at in ON_EDGES[kind]:
        for out in (1.0, 1 + 2.0**-10):
            x, y, z = (out * a for a in at)
            force, by_q = reading_by_q(marker(kind, (x, y, z), law, precision))
            assert not force.any() and not by_q.any()


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("law", FRICTION_LAWS)
@pytest.mark.parametrize(("kind", "at"), [("box", (12, 0, 4)), ("cylinder", (4, 0, 12))])
def test_marker_at_equal_distance_to_two_faces_uses_one_of_them(
    kind: str, at: tuple[float, float, float], law: str, precision: str
) -> None:
    """The first face of a box, the wall of a cylinder; the gradient is that of the side where this face is nearer."""
    sim = marker(kind, at, law, precision)
    force, by_q = reading_by_q(sim)
    np.testing.assert_array_equal(force, [4, 0, 0])
    bend = 0.0 if kind == "box" else 4 / (4 * UNIT)
    np.testing.assert_allclose(by_q, np.diag([-1024, bend, 0]), atol=1024 * ROUNDING[precision])
    if precision == "double":
        for direction in ((1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, -1), (1, 0, -1)):
            sim.q[0] = 2.0**-30 * np.array(direction)
            slope = (sim.tactile()[0, 0] * [1, 1, -1] - force) / 2.0**-30
            np.testing.assert_allclose(by_q @ direction, slope, atol=1e-3)
        sim.q[0] = -(2.0**-30), 0, 0  # other side of the edge
        assert sim.tactile()[0, 0, 0] == 0


def lattice(half: Array, counts: tuple[int, int, int]) -> Array:
    """Points on the surface of a box, including edges and corners, (points, 3)."""
    all_points = np.array(list(product(*(np.linspace(-h, h, n) for h, n in zip(half, counts, strict=True)))))
    surface: Array = all_points[(np.abs(all_points) == half).any(axis=1)]
    return surface


def fitted(
    boxes: dict[str, tuple[Any, Any]], law: str, precision: Any, gravity: tuple[float, float, float]
) -> Simulator:
    """A free cube of 16 UNIT and fixed boxes (name → centre and half sizes [UNIT])."""
    spec = _core.ModelSpec()
    spec.gravity, spec.step, spec.polish = gravity, 2.0**-9, 2
    inertia = 0.25 * (16 * UNIT) ** 2 / 6
    cube = spec.add_body(_core.BodyDef(name="cube", mass=0.25, inertia=(inertia, inertia, inertia, 0, 0, 0)))
    spec.add_joint(_core.JointDef(name="cube", body=cube, type="free"))
    surface = lattice(np.full(3, 8 * UNIT), (5, 5, 5))
    points = spec.add_points(_core.PointsDef(name="cube", body=cube, points=surface))
    for name, (centre, half) in boxes.items():
        shape = spec.add_shape(
            _core.ShapeDef(name=name, kind="box", pos=UNIT * np.array(centre), size=UNIT * np.array(half))
        )
        spec.add_contact(_core.ContactDef(name=f"on {name}", points=points, shape=shape, **law_of(law)))
    sim = Simulator(_core.Model(spec), precision=precision)
    sim.q[0, 3] = 1
    return sim


SAME = {"base": ((0, 0, -16), (8, 8, 8))}  # below the cube, same size: five faces coplanar with the cube's
HOLE = {  # a hole of the cube's size
    "floor": ((0, 0, -16), (24, 24, 8)),
    "left": ((-16, 0, 0), (8, 24, 8)),
    "right": ((16, 0, 0), (8, 24, 8)),
    "front": ((0, -16, 0), (24, 8, 8)),
    "back": ((0, 16, 0), (24, 8, 8)),
}


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("law", FRICTION_LAWS)
@pytest.mark.parametrize("boxes", [SAME, HOLE], ids=["on a box of its size", "in a hole of its size"])
def test_coplanar_faces_have_no_contact_force(boxes: dict[str, Any], law: str, precision: str) -> None:
    """Without load nothing moves, and gradients are those of the side without contact."""
    sim = fitted(boxes, law, precision, (0, 0, 0))
    u, start = np.zeros((4, 1, 0)), sim.q.copy()
    run = sim.rollout(u)
    np.testing.assert_array_equal(run.q[-1], start)
    lifted = np.array([[0, 0, 2.0**-12, 0, 0, 0]])
    away = sim.rollout(u, v=lifted)
    for part, end in (("q", run.q), ("v", run.v)):
        weights = np.zeros_like(end)
        weights[-1] = np.random.default_rng(0).normal(size=end.shape[1:])
        gradient = sim.rollout_gradient(run, q=weights) if part == "q" else sim.rollout_gradient(run, v=weights)
        assert all(np.isfinite(x).all() for x in (gradient.q, gradient.v, gradient.anchors))
        change = ((getattr(away, part) - end) * weights).sum() / 2.0**-12
        assert (gradient.v * lifted).sum() / 2.0**-12 == pytest.approx(change, rel=ROUNDING[precision])
    if precision == "double":
        rng = np.random.default_rng(1)
        for output in ("q", "v"):
            assert (
                compare_to_dual_numbers(RolloutLoss.random(sim, u[:, 0], output, rng), rng, directions=2).error < 1e-10
            )


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("law", FRICTION_LAWS)
@pytest.mark.parametrize("boxes", [SAME, HOLE], ids=["on a box of its size", "in a hole of its size"])
def test_load_on_coincident_faces_gives_a_vertical_force(boxes: dict[str, Any], law: str, precision: str) -> None:
    """On a box of equal size nine points carry the load: those inside the face, since points on the edges have no
    force. In the hole all twenty-five carry it. The walls beside the box push equally from each side."""
    sim = fitted(boxes, law, precision, (0, 0, -8))
    sim.step(np.zeros(0), 1000)
    sim.check()
    carrying = 9 if boxes is SAME else 25
    newton = 1e-10 if precision == "double" else 1e-7  # [m], of its tolerance
    assert sim.q[0, 2] == pytest.approx(-0.25 * 8 / (1024 * carrying), abs=newton)
    np.testing.assert_allclose(sim.q[0, :2], 0, atol=UNIT * ROUNDING[precision])
    np.testing.assert_allclose(sim.q[0, 3:], [1, 0, 0, 0], atol=ROUNDING[precision])
    sim.v[0] = [
        1e-4,
        2e-4,
        3e-4,
        1e-2,
        2e-2,
        3e-2,
    ]  # at rest the gradient with respect to dry friction is dominated by rounding
    u = np.zeros((3, 1, 0))
    run = sim.rollout(u)
    gradient = sim.rollout_gradient(run, q=1.0, v=1.0)
    assert all(np.isfinite(x).all() for x in (gradient.q, gradient.v, gradient.anchors))
    if precision == "double":
        rng = np.random.default_rng(2)
        for output in ("q", "v"):
            assert (
                compare_to_dual_numbers(RolloutLoss.random(sim, u[:, 0], output, rng), rng, directions=2).error < 1e-10
            )


def hanging_over(law: str, precision: Any) -> Simulator:
    """A colliding pad of 8 × 8 markers, UNIT deep in a block below four of its rows; one row is on its edge."""
    spec = _core.ModelSpec()
    spec.gravity, spec.step, spec.polish = (0, 0, 0), 2.0**-14, 2
    hand = spec.add_body(_core.BodyDef(name="hand", pos=(0, 0, -UNIT), mass=0.25, inertia=(1e-4, 1e-4, 1e-4, 0, 0, 0)))
    spec.add_joint(_core.JointDef(name="hand", body=hand, type="free"))
    block = spec.add_body(
        _core.BodyDef(name="block", pos=(-16 * UNIT, 0, -8 * UNIT), mass=0.5, inertia=(1e-4,) * 3 + (0,) * 3)
    )
    spec.add_joint(_core.JointDef(name="block", body=block, type="free"))
    shape = spec.add_shape(_core.ShapeDef(name="block", body=block, kind="box", size=UNIT * np.array([16, 16, 8])))
    along = 2 * UNIT * np.arange(-4, 4)  # along x: four rows above the block, one on its edge at x = 0, three outside
    places = np.array([(x, y + UNIT, 0) for x in along for y in along])
    axes = [np.tile(axis, (64, 1)) for axis in ((1, 0, 0), (0, -1, 0), (0, 0, -1))]
    spec.add_pad(
        _core.PadDef(
            name="pad",
            body=hand,
            positions=places,
            axes=np.stack(axes, axis=-1),
            shapes=[shape],
            collides=True,
            **law_of(law),
        )
    )
    sim = Simulator(_core.Model(spec), precision=precision)
    poses = [[0, 0, -UNIT, 1, 0, 0, 0], [-16 * UNIT, 0, -8 * UNIT, 1, 0, 0, 0]]
    sim.q[0] = np.ravel(poses)
    return sim


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("law", FRICTION_LAWS)
def test_pad_that_overhangs_a_body(law: str, precision: str) -> None:
    """Only the markers above the body have forces, with depth UNIT, whose sum is the contact wrench; those on the edge
    have none."""
    sim = hanging_over(law, precision)
    depth = sim.tactile()[0].reshape(8, 8, 3)[..., 2]
    np.testing.assert_array_equal(depth, np.repeat([1.0, 0.0], 4)[:, None] * np.ones(8))
    sim.v[0, :2] = UNIT, -2 * UNIT  # sliding
    sim.step(np.zeros(0), 2)
    sim.check()
    reading, wrench = sim.tactile()[0].reshape(8, 8, 3).astype(float), sim.wrenches()[0, 0]
    assert reading[:4].any(axis=2).all() and np.abs(reading[:4, :, :2]).max() > 1e-2
    assert np.abs(reading[4]).max() < 1e-3 and not reading[5:].any()  # the block rotates slightly
    axes = np.array([(1, 0, 0), (0, -1, 0), (0, 0, 1)])  # the pad's z points down; the normal component is −f · z
    total = rotate(sim.q[0, 3:7], (reading @ axes).sum((0, 1)))
    size = np.linalg.norm(reading, axis=2).sum()
    np.testing.assert_allclose(total, wrench[3:], atol=ROUNDING[precision] * size)
    run = sim.rollout(np.zeros((3, 1, 0)), read_after=[0, 3])
    assert not run.status.any()
    gradient = sim.rollout_gradient(run, q=1.0, v=1.0, tactile=1.0)
    assert all(np.isfinite(x).all() for x in (gradient.q, gradient.v, gradient.anchors))
    if precision == "double":
        rng = np.random.default_rng(3)
        for output in ("q", "v", "tactile"):
            assert (
                compare_to_dual_numbers(RolloutLoss.random(sim, np.zeros((3, 0)), output, rng), rng, directions=2).error
                < 1e-10
            )
