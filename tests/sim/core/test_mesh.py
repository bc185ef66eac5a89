"""Distance grids and rounded shapes: consistent, smooth, with exact gradients in contact."""

import itertools
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.sim import _core
from gelflow.sim.scene.geometry.distance_grid import DistanceGrid, spline_grid
from gelflow.sim.scene.model_spec import core_grid
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation import gradient_check
from gelflow.sim.validation import reference_meshes as mesh_solids

Array = NDArray[np.float64]

OUTPUTS: tuple[gradient_check.Output, ...] = ("q", "v", "tactile")
RADIUS = 0.02
BRACKET = (0.04, 0.012, 0.02)  # arm, thickness, depth
ROUNDED: dict[str, tuple[float, float, float]] = {"box": (0.03, 0.02, 0.01), "cylinder": (0.02, 0.03, 0)}
ROUNDING = 0.004
KINDS = ("grid", "box", "cylinder")


def sphere_grid(cells: int) -> DistanceGrid:
    """Grid of exact distances to a sphere, with `cells` along the diameter."""
    spacing = 2 * RADIUS / cells
    line = spacing * np.arange(cells + 7) - RADIUS - 3 * spacing
    x, y, z = np.meshgrid(line, line, line, indexing="ij")
    return spline_grid(np.sqrt(x**2 + y**2 + z**2) - RADIUS, np.full(3, line[0]), spacing)


def bracket_grid(cells: int) -> DistanceGrid:
    spacing = BRACKET[0] / cells
    low, high = np.array([0, 0, -BRACKET[2] / 2]), np.array([BRACKET[0], BRACKET[0], BRACKET[2] / 2])
    lines = [np.arange(a - 3 * spacing, b + 3.5 * spacing, spacing) for a, b in zip(low, high, strict=True)]
    nodes = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
    distances = mesh_solids.bracket_distance(nodes.reshape(-1, 3), *BRACKET)
    return spline_grid(distances.reshape(nodes.shape[:3]), low - 3 * spacing, spacing)


def model_of(
    kind: str, size: Any, points: Array | None = None, *, rounding: float = 0.0, grid: DistanceGrid | None = None
) -> _core.Model:
    """A fixed shape "shape" and fixed markers of 1 N/m."""
    spec = _core.ModelSpec()
    spec.gravity = (0, 0, 0)
    body = spec.add_body(_core.BodyDef(name="probe", mass=1.0, inertia=(1, 1, 1, 0, 0, 0)))
    spec.add_joint(_core.JointDef(name="slide", body=body, type="slide", axis=(1, 0, 0)))
    shape = spec.add_shape(
        _core.ShapeDef(
            name="shape", kind=kind, size=size, rounding=rounding, grid=core_grid(grid) if grid is not None else None
        )
    )
    if points is not None:
        spec.add_pad(
            _core.PadDef(name="pad", body=body, positions=points, shapes=[shape], kn=1.0, kt=0.0, mu=0.0, kd=0.0)
        )
    return _core.Model(spec)


def shape_of(kind: str) -> Any:
    """A model with one shape: a sphere's grid, or a rounded solid."""
    if kind == "grid":
        return model_of("grid", (1, 0, 0), grid=sphere_grid(16))
    return model_of(kind, ROUNDED[kind], rounding=ROUNDING)


def inside_points(kind: str, count: int, seed: int = 0) -> Array:
    reach = (RADIUS,) * 3 if kind == "grid" else (0.02, 0.02, 0.03) if kind == "cylinder" else ROUNDED[kind]
    points = np.random.default_rng(seed).uniform(-1.05, 1.05, (count, 3)) * reach
    kept: Array = points[np.linalg.norm(points, axis=1) > 2e-3]
    return kept  # not near the centre of a sphere, where the curvature is unbounded


def differenced(model: Any, points: Array, step: float = 1e-7) -> tuple[Array, Array]:
    """Central differences: gradient of d and derivative of n."""
    ends = [[model.distance("shape", points + s * step * axis) for s in (-1, 1)] for axis in np.eye(3)]
    by = [[(high - low) / (2 * step) for low, high in zip(*pair, strict=True)] for pair in ends]
    return np.stack([d for d, _, _ in by], axis=-1), np.stack([n for _, n, _ in by], axis=-1)


@pytest.mark.parametrize("kind", KINDS)
def test_normal_and_curvature_are_the_derivatives(kind: str) -> None:
    model, points = shape_of(kind), inside_points(kind, 3000)
    _, normal, hessian = model.distance("shape", points)
    by_d, by_n = differenced(model, points)
    # Away from the transitions of a rounded solid, where the curvature jumps, and the normal inside the smaller solid.
    jumps = np.abs(by_n - hessian).max((1, 2)) > 1e-5 * np.abs(hessian).max()
    assert jumps.mean() < (1e-9 if kind == "grid" else 2e-3)
    np.testing.assert_allclose(by_d[~jumps], normal[~jumps], atol=1e-6)
    np.testing.assert_array_equal(hessian, hessian.transpose(0, 2, 1))


def test_second_derivatives_are_continuous_across_cells() -> None:
    grid = sphere_grid(16)
    model = model_of("grid", (1, 0, 0), grid=grid)
    rng = np.random.default_rng(1)
    border = grid.origin + grid.spacing * rng.integers(5, 18, (500, 3))  # cell corners, where all three indices change
    way = 1e-10 * rng.normal(size=(500, 3))
    for low, high in zip(model.distance("shape", border - way), model.distance("shape", border + way), strict=True):
        assert np.abs(high - low).max() < 1e-6 * np.abs(high).max()


def test_grid_of_a_sphere_converges_at_fourth_order() -> None:
    points = inside_points("grid", 4000)
    length = np.linalg.norm(points, axis=1)
    points = points[(length > RADIUS / 2) & (length < RADIUS)]
    length = np.linalg.norm(points, axis=1)
    errors = []
    for cells in (8, 16, 32):
        d, n, hessian = model_of("grid", (1, 0, 0), grid=sphere_grid(cells)).distance("shape", points)
        outwards = points / length[:, None]
        round_about = (np.eye(3) - outwards[:, :, None] * outwards[:, None]) / length[:, None, None]
        errors.append(
            [np.abs(d - length + RADIUS).max(), np.abs(n - outwards).max(), np.abs(hessian - round_about).max()]
        )
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert (orders > [3, 2.3, 1.3]).all(), orders  # of distance, normal, curvature: 4, 3, 2 in the limit
    assert errors[-1][0] < 1e-7
    lengths = np.linalg.norm(n, axis=1)
    assert np.abs(lengths - 1).max() < 1e-4


def test_sign_of_a_bracket_is_correct_everywhere() -> None:
    grid = bracket_grid(32)
    points = np.random.default_rng(2).uniform(-0.03, 0.07, (20_000, 3))  # also far outside of the grid
    d, _, _ = model_of("grid", (1, 0, 0), grid=grid).distance("shape", points)
    exact = mesh_solids.bracket_distance(points, *BRACKET)
    clear = np.abs(exact) > 0.3 * grid.spacing  # sharp edges are rounded by a fraction of a cell
    assert ((d < 0) == (exact < 0))[clear].all()
    assert (exact < 0).sum() > 100


def test_broad_phase_keeps_all_markers_in_contact() -> None:
    """Markers are tested in blocks; excluded blocks have no contact."""
    points = np.random.default_rng(3).uniform(-0.03, 0.07, (30_000, 3))
    for scale in (1.0, 0.7, 1.6):
        model = model_of("grid", (scale, 0, 0), points, grid=bracket_grid(20))
        d, n, _ = model.distance("shape", points)
        force = Simulator(model).tactile()[0] * [1, 1, -1]
        np.testing.assert_allclose(force, np.where(d < 0, -d, 0)[:, None] * n, atol=1e-15)
        assert (d < 0).sum() > 100


@pytest.mark.parametrize("kind", ROUNDED)
def test_broad_phase_keeps_all_points_in_a_rounded_solid(kind: str) -> None:
    points = inside_points(kind, 5000)
    model = model_of(kind, ROUNDED[kind], points, rounding=ROUNDING)
    d, n, _ = model.distance("shape", points)
    force = Simulator(model).tactile()[0] * [1, 1, -1]
    np.testing.assert_allclose(force, np.where(d < 0, -d, 0)[:, None] * n, atol=1e-15)


def rounded_distance(kind: str, points: Array) -> Array:
    """Exact distance, from that to the smaller solid."""
    a, b, c = ROUNDED[kind]
    if kind == "box":
        beyond = np.abs(points) - (np.array([a, b, c]) - ROUNDING)
    else:
        across = np.column_stack([np.hypot(points[:, 0], points[:, 1]), np.abs(points[:, 2])])
        beyond = across - (np.array([a, b]) - ROUNDING)
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    result: Array = outside + np.minimum(beyond.max(1), 0) - ROUNDING
    return result


@pytest.mark.parametrize("kind", ROUNDED)
def test_rounded_solid_is_exact_and_smooth_between_its_faces(kind: str) -> None:
    model, points = shape_of(kind), inside_points(kind, 5000)
    d, n, _ = model.distance("shape", points)
    np.testing.assert_allclose(d, rounded_distance(kind, points), atol=1e-16)
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1, atol=1e-14)
    # Transitions between face, edge and corner: one coordinate is that of a face of the smaller solid.
    seam = points[:500].copy()
    radius, half = ROUNDED["cylinder"][0] - ROUNDING, ROUNDED["cylinder"][1] - ROUNDING
    if kind == "box":
        seam[:, :2] = np.sign(seam[:, :2]) * (np.array(ROUNDED["box"][:2]) - ROUNDING * np.array([0.4, 1]))
        across = np.tile([0, 1e-9, 0], (len(seam), 1))
    else:
        outwards = seam[:, :2] / np.linalg.norm(seam[:, :2], axis=1)[:, None]
        seam[:, :2] = outwards * radius
        seam[:, 2] = np.sign(seam[:, 2]) * (half + 0.6 * ROUNDING)
        across = np.column_stack([1e-9 * outwards, np.zeros(len(seam))])
    low, high = (model.distance("shape", seam + s * across) for s in (-1, 1))
    assert (low[0] < 0).sum() > 100
    np.testing.assert_allclose(high[0], low[0], atol=3e-9)
    np.testing.assert_allclose(high[1], low[1], atol=1e-5)


@pytest.mark.parametrize("kind", ROUNDED)
def test_edges_without_rounding_are_sharp(kind: str) -> None:
    points = inside_points(kind, 2000)
    sharp = model_of(kind, ROUNDED[kind]).distance("shape", points)
    none = model_of(kind, ROUNDED[kind], rounding=0.0).distance("shape", points)
    little = model_of(kind, ROUNDED[kind], rounding=1e-9).distance("shape", points)
    for a, b in zip(sharp, none, strict=True):
        np.testing.assert_array_equal(a, b)
    inside = sharp[0] < -1e-8
    np.testing.assert_allclose(little[0][inside], sharp[0][inside], atol=1e-15)
    np.testing.assert_array_equal(little[1][inside], sharp[1][inside])


def shape_def(kind: str, body: int) -> _core.ShapeDef:
    """A rounded solid, a sphere as a grid, or the bracket's sharp edge ("edge")."""
    if kind in ROUNDED:
        return _core.ShapeDef(
            name="shape", body=body, kind=kind, pos=(1e-3, 0, 0), size=ROUNDED[kind], rounding=ROUNDING
        )
    pos, size, grid = (
        ((1e-3, 0, 0), (1.2, 0, 0), sphere_grid(10))
        if kind == "grid"
        else ((-0.01, -0.006, -0.01), (1, 0, 0), bracket_grid(16))
    )
    return _core.ShapeDef(name="shape", body=body, kind="grid", pos=pos, size=size, grid=core_grid(grid))


def pressed(kind: str, law: str, rng: np.random.Generator, precision: Any = "double") -> tuple[Simulator, Array]:
    """A cloud of points on a ball joint, pressed onto a shape on a hinge; "edge": a sharp edge of a grid."""
    spec = _core.ModelSpec()
    spec.tolerance = 1e-13
    turret = spec.add_body(_core.BodyDef(name="turret", mass=0.1, inertia=(1e-4, 1e-4, 1e-4, 0, 0, 0)))
    spec.add_joint(_core.JointDef(name="turn", body=turret, type="hinge", axis=(0.3, 0.2, 1), damping=1e-3))
    hand = spec.add_body(_core.BodyDef(name="hand", mass=0.02, com=(0, 0, 1e-3), inertia=(1e-5, 2e-5, 1e-5, 0, 0, 0)))
    slides = [
        spec.add_joint(_core.JointDef(name=name, body=hand, type="slide", axis=axis, damping=0.5))
        for name, axis in (("x", (1, 0, 0)), ("z", (0, 0, 1)))
    ]
    spec.add_joint(_core.JointDef(name="ball", body=hand, type="ball", pos=(0, 0, 0.002), damping=1e-3))
    shape = spec.add_shape(shape_def(kind, turret))
    cloud = rng.normal(size=(60, 3))
    cloud *= 0.012 / np.linalg.norm(cloud, axis=1)[:, None]
    numbers: dict[str, Any] = {"law": law, "kn": 200.0, "kt": 2.0, "mu": 0.3, "kd": 20.0}
    numbers["ks"] = 100.0 if law == "elastic" else 0.0
    spec.add_contact(
        _core.ContactDef(
            name="press",
            points=spec.add_points(_core.PointsDef(name="cloud", body=hand, points=cloud)),
            shape=shape,
            **numbers,
        )
    )
    spec.add_pad(
        _core.PadDef(name="skin", body=hand, positions=cloud * 1.01, shapes=[shape], **{**numbers, "kn": 50.0})
    )
    spec.add_actuator(_core.ActuatorDef(name="x", joint=slides[0], kind="position", kp=100.0, kd=1.0))
    spec.add_actuator(_core.ActuatorDef(name="z", joint=slides[1], kind="position", kp=300.0, kd=1.0))
    sim = Simulator(_core.Model(spec), precision=precision)
    top = {"grid": 1.2 * RADIUS, "box": 0.01, "cylinder": 0.03, "edge": -1e-3}[kind]
    # Near the edge of a rounded solid: on its face and its rounding.
    aside = {"grid": 0.0, "box": 0.024, "cylinder": 0.015, "edge": -0.012}[kind]
    height = top + 0.012
    sim.q[0, sim.model.joint_q[1]], sim.q[0, sim.model.joint_q[2]] = aside, height
    hold = np.array([aside, height - 2e-3])
    sim.step(hold + rng.normal(size=2) * [3e-3, 2e-4], 12)
    sim.check()
    return sim, hold + rng.normal(size=(3, 2)) * [5e-3, 2e-4]


@pytest.mark.parametrize("law", ["viscous", "elastic"])
@pytest.mark.parametrize("kind", [*KINDS, "edge"])
def test_gradients_of_points_pressed_onto_a_shape(kind: str, law: str) -> None:
    """With respect to controls, state and parameters, including the scale of a grid and the rounding of a solid."""
    skipped = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        sim, u = pressed(kind, law, rng)
        assert (sim.tactile() != 0).any()
        for output in OUTPUTS:
            case = gradient_check.RolloutLoss.random(sim, u, output, rng)
            assert gradient_check.compare_to_dual_numbers(case, rng, directions=1).error < 1e-10
        if kind == "edge":
            # Where the normal is short, an elastic marker at the slip limit can be evaluated as sticking or slipping,
            # a kink that is not in the contact mode signature. Positions and velocities have no such kink.
            case = gradient_check.RolloutLoss.random(sim, u, OUTPUTS[seed % 2], rng)
        agreement = gradient_check.compare_to_differences(case)
        skipped.append(agreement.skipped)
        assert agreement.error < 1e-6
    assert np.mean(skipped) <= 0.1


@pytest.mark.parametrize("kind", ["grid", "box"])
def test_single_precision_agrees_with_double(kind: str) -> None:
    runs = [pressed(kind, "elastic", np.random.default_rng(0), precision)[0] for precision in ("double", "single")]
    double, single = (sim.tactile()[0] for sim in runs)
    assert np.abs(double).max() > 1e-3
    np.testing.assert_allclose(single, double, atol=3e-3 * float(np.abs(double).max()))


def test_scaled_grid_equals_a_larger_shape() -> None:
    points = inside_points("grid", 1000)
    grid = sphere_grid(12)
    d, n, hessian = model_of("grid", (1, 0, 0), grid=grid).distance("shape", points)
    larger = model_of("grid", (2, 0, 0), grid=grid).distance("shape", 2 * points)
    for ours, expected in zip(larger, (2 * d, n, hessian / 2), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=1e-13, atol=1e-15)


GRID_FAULTS: list[tuple[NDArray[np.float32], float, str]] = [
    (np.ones((6, 6), np.float32), 0.1, "coefficients must have shape"),
    (np.ones((6, 6, 5), np.float32), 0.1, "at least 3 cells"),
    (-np.ones((8, 8, 8), np.float32), 0.1, "border of cells outside"),
    (np.full((8, 8, 8), np.nan, np.float32), 0.1, "not finite"),
    (np.ones((8, 8, 8), np.float32), 0.0, "positive spacing"),
]


@pytest.mark.parametrize(("coefficients", "spacing", "message"), GRID_FAULTS, ids=[fault[2] for fault in GRID_FAULTS])
def test_invalid_grid_raises(coefficients: NDArray[np.float32], spacing: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        _core.DistanceGrid(origin=(0, 0, 0), spacing=spacing, coefficients=coefficients)


def test_shape_with_an_invalid_grid_or_rounding_raises() -> None:
    grid = _core.DistanceGrid(origin=(0, 0, 0), spacing=0.1, coefficients=np.ones((8, 8, 8), np.float32))
    with pytest.raises(ValueError, match="a grid goes with the kind grid"):
        _core.ModelSpec().add_shape(_core.ShapeDef(name="s", kind="grid", size=(1, 0, 0)))
    with pytest.raises(ValueError, match="only a box or a cylinder"):
        _core.ModelSpec().add_shape(_core.ShapeDef(name="s", kind="grid", size=(1, 0, 0), grid=grid, rounding=0.1))


@pytest.mark.parametrize(("kind", "rounding"), list(itertools.product(ROUNDED, (-1e-3, 0.05, float("nan")))))
def test_invalid_rounding_raises(kind: str, rounding: float) -> None:
    with pytest.raises(ValueError, match="rounding must"):
        _core.ModelSpec().add_shape(_core.ShapeDef(name="s", kind=kind, size=ROUNDED[kind], rounding=rounding))
