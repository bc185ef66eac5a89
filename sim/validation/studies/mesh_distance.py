"""Accuracy and speed of the distance grids of meshes, compared with exact solids.

Grids of several resolutions are built from meshes of a sphere, a box, a cylinder, an L-bracket and a box with edges
rounded by 3 mm:

* distance and normal at random points down to 2 mm below the surface; the error of the normal is the length of the
  vector difference, and the error of its length is given separately
* force on a ball of points with stiffness per area, pressed 0.5 mm into the surface at random locations, edges included
* build time, size, and the time of a point in contact, compared with that of an exact box
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from gelflow.sim import _core
from gelflow.sim.scene.geometry.distance_grid import DistanceGrid, build_grid
from gelflow.sim.scene.geometry.mesh import TriangleMesh, nearest_points
from gelflow.sim.scene.geometry.sampling import capsule, mesh_surface
from gelflow.sim.scene.model_spec import core_grid
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation import reference_meshes as mesh_solids

Array = NDArray[np.float64]

RESOLUTIONS = (8, 16, 32, 64, 128)
BAND = 2e-3  # largest depth below the surface [m]
POINTS, CENTERS = 20_000, 300
BALL, INDENTATION, POINTS_ON_BALL = 5e-3, 5e-4, 2000  # radius [m], depth [m], contact points
ROUNDING = 3e-3  # [m]
BRACKET = (0.06, 0.015, 0.03)  # arm, thickness, depth [m]
SIZES = {"sphere": (0.03, 0, 0), "box": (0.03, 0.02, 0.01), "cylinder": (0.02, 0.03, 0)}
SPHERE_VERTICES = 40_000  # the triangles lie up to 2.5 µm below the sphere

Exact = Callable[[Array], tuple[Array, Array]]  # points (n, 3) → distances (n,), normals (n, 3)


@dataclass(frozen=True)
class Solid:
    """A mesh, and the exact distance function of the solid."""

    name: str
    mesh: TriangleMesh
    exact: Exact
    rounding: float = 0.0


@dataclass(frozen=True)
class Result:
    """Errors of one grid: root mean square and largest. Lengths in m."""

    solid: str
    resolution: int
    spacing: float
    distance_rms: float
    distance_worst: float
    normal_rms: float
    normal_worst: float
    length_rms: float  # length of the normal minus 1
    length_worst: float
    force_median: float  # relative
    force_rms: float
    force_worst: float
    build_seconds: float
    bytes: int


def spec_with(
    kind: str, size: Any, *, grid: DistanceGrid | None = None, rounding: float = 0.0
) -> tuple[_core.ModelSpec, int]:
    """A ModelSpec with a fixed shape "shape" and a ball on three slides, and the index of the shape."""
    spec = _core.ModelSpec()
    spec.gravity = (0, 0, 0)
    distances = core_grid(grid) if grid is not None else None
    shape = spec.add_shape(_core.ShapeDef(name="shape", kind=kind, size=size, rounding=rounding, grid=distances))
    body = spec.add_body(_core.BodyDef(name="ball", mass=0.1, inertia=(1e-5, 1e-5, 1e-5, 0, 0, 0)))
    for name, axis in zip("xyz", np.eye(3), strict=True):
        spec.add_joint(_core.JointDef(name=name, body=body, type="slide", axis=axis))
    return spec, shape


def solids() -> list[Solid]:
    def by_core(kind: str, rounding: float = 0.0) -> Exact:
        model = _core.Model(spec_with(kind, SIZES[kind], rounding=rounding)[0])

        def exact(points: Array) -> tuple[Array, Array]:
            distances, normals, _ = model.distance("shape", points)
            return distances, normals

        return exact

    def of_bracket(points: Array) -> tuple[Array, Array]:
        distances = mesh_solids.bracket_distance(points, *BRACKET)
        nearest = nearest_points(bracket, points, "bracket")
        return distances, (points - nearest) / np.where(distances == 0, 1, distances)[:, None]

    bracket = mesh_solids.bracket(*BRACKET)
    box = mesh_solids.box(SIZES["box"])
    return [
        Solid("sphere", mesh_solids.sphere(SIZES["sphere"][0], SPHERE_VERTICES), by_core("sphere")),
        Solid("box", box, by_core("box")),
        Solid("cylinder", mesh_solids.cylinder(*SIZES["cylinder"][:2], around=360), by_core("cylinder")),
        Solid("bracket", bracket, of_bracket),
        Solid("rounded", box, by_core("box", ROUNDING), ROUNDING),
    ]


def inside(solid: Solid, rng: np.random.Generator) -> Array:
    """Random points inside the solid, at most `BAND` below its surface."""
    low, high = solid.mesh.vertices.min(0), solid.mesh.vertices.max(0)
    accepted = np.zeros((0, 3))
    while len(accepted) < POINTS:
        points = rng.uniform(low, high, (POINTS, 3))
        distances, _ = solid.exact(points)
        accepted = np.concatenate([accepted, points[(distances < 0) & (distances > -BAND)]])
    return accepted[:POINTS]


def ball_centers(solid: Solid) -> Array:
    """Ball centres over points spread on the surface, at which the ball reaches `INDENTATION` below the surface."""
    on_surface, _ = mesh_surface(solid.mesh, count=CENTERS)
    distances, normals = solid.exact(on_surface - 1e-9)
    if solid.rounding:  # points on sharp edges of the mesh lie outside of the rounded solid
        on_surface = on_surface - distances[:, None] * normals
    centers = on_surface + (BALL - INDENTATION) * normals
    reached: Array = centers[np.abs(solid.exact(centers)[0] - (BALL - INDENTATION)) < 1e-4]
    return reached


def force_errors(solid: Solid, grid: DistanceGrid) -> tuple[float, float, float]:
    """Errors of the contact force on the ball relative to the exact one: median, root mean square, largest."""
    ball, across = capsule(BALL, 0.0, count=POINTS_ON_BALL)
    areas = across.sum(1)
    spec, shape = spec_with("grid", (1, 0, 0), grid=grid)
    stiffness = 1e7  # [N/m³]
    spec.add_contact(
        _core.ContactDef(
            name="press",
            points=spec.add_points(_core.PointsDef(name="ball", body=0, points=ball, weights=areas)),
            shape=shape,
            kn=stiffness,
            kt=0.0,
            mu=0.0,
            kd=0.0,
        )
    )
    centers = ball_centers(solid)
    sim = Simulator(_core.Model(spec), num_envs=len(centers), threads=1)
    sim.q[:] = centers
    forces = sim.wrenches()[:, 0, 3:]
    errors = []
    for center, force in zip(centers, forces, strict=True):
        distances, normals = solid.exact(ball + center)
        exact = (stiffness * areas * np.maximum(-distances, 0)) @ normals
        errors.append(np.linalg.norm(force - exact) / np.linalg.norm(exact))
    return float(np.median(errors)), float(np.sqrt(np.mean(np.square(errors)))), float(np.max(errors))


def grid_errors(solid: Solid, resolution: int, points: Array) -> tuple[Result, DistanceGrid]:
    """Build a grid and measure its errors."""
    begin = time.perf_counter()
    grid = build_grid(solid.mesh, solid.name, resolution=resolution, rounding=solid.rounding)
    seconds = time.perf_counter() - begin
    exact_distances, exact_normals = solid.exact(points)
    model = _core.Model(spec_with("grid", (1, 0, 0), grid=grid)[0])
    distances, normals, _ = model.distance("shape", points)
    normal_errors = np.linalg.norm(normals - exact_normals, axis=1)
    pairs = [
        (float(np.sqrt(np.mean(np.square(error)))), float(np.abs(error).max()))
        for error in (distances - exact_distances, normal_errors, np.linalg.norm(normals, axis=1) - 1)
    ]
    (d_rms, d_worst), (n_rms, n_worst), (l_rms, l_worst) = pairs
    forces = force_errors(solid, grid)
    result = Result(
        solid.name, resolution, grid.spacing, d_rms, d_worst, n_rms, n_worst, l_rms, l_worst, *forces, seconds,
        grid.nbytes,
    )  # fmt: skip
    return result, grid


def microseconds_per_point(kind: str, grid: DistanceGrid | None, repeats: int) -> dict[str, float]:
    """Time of a point in contact: in one evaluation of contact forces with derivatives, and of tactile forces [µs].

    The difference between many and few points inside the shape; the fastest of the repeats.
    """
    seconds = {}
    for count in (200, 5000):
        line = np.random.default_rng(0).uniform(-1, 1, (count, 3)) * (0.01, 0.01, 1e-3) + (0, 0, 0.0085)
        spec, shape = spec_with(kind, (1, 0, 0) if grid is not None else SIZES["box"], grid=grid)
        numbers: dict[str, Any] = {"kn": 1e-3, "kt": 1e-3, "mu": 0.5, "kd": 0.0}
        spec.add_contact(
            _core.ContactDef(
                name="press",
                points=spec.add_points(_core.PointsDef(name="line", body=0, points=line)),
                shape=shape,
                **numbers,
            )
        )
        spec.add_pad(_core.PadDef(name="pad", body=0, positions=line, shapes=[shape], **numbers))
        sim = Simulator(_core.Model(spec), threads=1)
        for name, work in (("step", lambda sim=sim: sim.step(np.zeros(0))), ("reading", sim.tactile)):
            times = []
            for _ in range(repeats):
                sim.reset()
                begin = time.perf_counter()
                work()
                times.append(time.perf_counter() - begin)
            evaluations = int(sim.iterations[0]) + 1  # of the contact forces; tactile forces are evaluated once
            seconds[name, count] = min(times) / evaluations
    return {name: (seconds[name, 5000] - seconds[name, 200]) / 4800 * 1e6 for name in ("step", "reading")}


def short(number: float, digits: int = 2) -> str:
    """A number in `digits` significant digits, without exponent where that is shorter."""
    if number >= 10:
        return f"{number:.0f}"
    return f"{number:.{digits}g}" if number >= 1e-3 else f"{number:.0e}".replace("e-0", "e-")


def error_table(results: Sequence[Result]) -> Table:
    """Errors, build time and size of all grids."""
    out = Table(
        title="errors: root mean square / largest; force: median / largest",
        title_justify="left",
        box=None,
        padding=(0, 1, 0, 0),
    )
    for column in ("solid", "cells", "distance µm", "normal", "‖n‖ − 1", "force %", "build s", "MB"):
        out.add_column(column, justify="left" if column == "solid" else "right", no_wrap=True)
    for r in results:
        out.add_row(
            r.solid,
            str(r.resolution),
            f"{short(r.distance_rms * 1e6)} / {short(r.distance_worst * 1e6)}",
            f"{short(r.normal_rms, 1)} / {short(r.normal_worst, 1)}",
            short(r.length_rms, 1),
            f"{short(r.force_median * 100, 1)} / {short(r.force_worst * 100)}",
            f"{r.build_seconds:.1f}",
            f"{r.bytes / 1e6:.2f}",
        )
        if r.resolution == max(RESOLUTIONS):
            out.add_row()
    return out


def measure(
    progress: Callable[[float], None], *, quick: bool = False, repeats: int = 200, seed: int = 0
) -> tuple[list[Result], dict[str, dict[str, float]]]:
    """Errors of all grids, and times per contact point [µs] of the box's grids and of the exact box.

    With `quick` resolutions up to 32. `progress` is advanced by shares that add up to 1.
    """
    largest = 32 if quick else max(RESOLUTIONS)
    tasks = [
        (s, n) for s in solids() for n in RESOLUTIONS if n <= largest and (s.rounding >= 0.12 / n or not s.rounding)
    ]
    points = {s.name: inside(s, np.random.default_rng(seed)) for s, _ in tasks}
    results, times = [], {}
    for solid, resolution in tasks:
        result, grid = grid_errors(solid, resolution, points[solid.name])
        results.append(result)
        if solid.name == "box":
            times[str(resolution)] = microseconds_per_point("grid", grid, repeats)
        progress(1 / len(tasks))
    times["exact box"] = microseconds_per_point("box", None, repeats)
    return results, times


def time_table(times: Mapping[str, Mapping[str, float]]) -> Table:
    """Times per contact point."""
    out = Table(title="µs per point in contact", title_justify="left")
    for column in ("", "force and derivatives", "tactile force"):
        out.add_column(column, justify="right")
    for name, t in times.items():
        out.add_row(name if name == "exact box" else f"{name} cells", f"{t['step']:.3f}", f"{t['reading']:.3f}")
    return out
