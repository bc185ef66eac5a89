"""How well the distance grid of a mesh stands for the solid: `python benchmarks/mesh_distance.py`.

Grids of several resolutions are made of meshes of a sphere, a box, a cylinder, an L-bracket and a box with rounded
edges (`rounded`, by 3 mm), and compared with the exact solids:

* distance and normal at random points down to 2 mm below the surface. The normal's error is the length of the
  difference, so a normal that is too short counts too; how far its length is from 1 is also given by itself.
* the force on a ball of points, stiffness per area, that is pressed 0.5 mm into the solid at random places and rests
  there, as the simulator gives it, against the same sum of exact distances and normals. The places lie on the whole
  surface, edges included.
* time to build the grid, its size, and the time of one touching point in a step and in a reading, beside a box's.

Writes benchmarks/results/mesh_distance.json and docs/pictures/mesh_distance.png.
"""

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from gelflow.errors import GelflowError
from gelflow.measurement.machine import processor
from gelflow.sim import _core
from gelflow.sim.scene.geometry.distance_grid import DistanceGrid, build_grid
from gelflow.sim.scene.geometry.mesh import TriangleMesh, nearest_points
from gelflow.sim.scene.geometry.sampling import capsule, mesh_surface
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation import reference_meshes as mesh_solids

Array = NDArray[np.float64]

ROOT = Path(__file__).parents[1]
RESOLUTIONS = (8, 16, 32, 64, 128)
BAND = 2e-3  # [m] below the surface
POINTS, PLACES = 20_000, 300
BALL, PRESSED, POINTS_ON_BALL = 5e-3, 5e-4, 2000  # radius, depth [m]
ROUNDING = 3e-3  # [m]
BRACKET = (0.06, 0.015, 0.03)  # arm, thickness, depth [m]
SIZES = {"sphere": (0.03, 0, 0), "box": (0.03, 0.02, 0.01), "cylinder": (0.02, 0.03, 0)}
CORNERS = 40_000  # of the sphere's mesh: its triangles lie up to 2.5 µm below the sphere

Exact = Callable[[Array], tuple[Array, Array]]  # points (n, 3) → distances (n,), normals (n, 3)


@dataclass(frozen=True)
class Solid:
    name: str
    mesh: TriangleMesh
    exact: Exact
    rounding: float = 0.0


@dataclass(frozen=True)
class Result:
    """Errors are root mean square and worst. Lengths in m."""

    solid: str
    resolution: int
    spacing: float
    distance_rms: float
    distance_worst: float
    normal_rms: float
    normal_worst: float
    length_rms: float  # of the normal, less 1
    length_worst: float
    force_median: float  # relative
    force_rms: float
    force_worst: float
    build_seconds: float
    bytes: int


def spec_with(kind: str, size: Any, *, grid: DistanceGrid | None = None, rounding: float = 0.0) -> tuple[Any, int]:
    """A model builder with one shape "shape" that stands still, and that shape's number."""
    spec = _core.ModelSpec()
    spec.gravity = (0, 0, 0)
    rest = {}
    if grid is not None:
        rest = {"origin": grid.origin, "spacing": grid.spacing, "coefficients": grid.coefficients}
    shape = spec.add_shape("shape", -1, kind, (0, 0, 0), (1, 0, 0, 0), size, rounding=rounding, **rest)
    body = spec.add_body("ball", -1, (0, 0, 0), (1, 0, 0, 0), 0.1, (0, 0, 0), (1e-5, 1e-5, 1e-5, 0, 0, 0))
    for name, axis in zip("xyz", np.eye(3), strict=True):
        spec.add_joint(name, body, "slide", (0, 0, 0), axis)
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
        Solid("sphere", mesh_solids.sphere(SIZES["sphere"][0], CORNERS), by_core("sphere")),
        Solid("box", box, by_core("box")),
        Solid("cylinder", mesh_solids.cylinder(*SIZES["cylinder"][:2], around=360), by_core("cylinder")),
        Solid("bracket", bracket, of_bracket),
        Solid("rounded", box, by_core("box", ROUNDING), ROUNDING),
    ]


def inside(solid: Solid, rng: np.random.Generator) -> Array:
    """Random points down to `BAND` below the surface."""
    low, high = solid.mesh.vertices.min(0), solid.mesh.vertices.max(0)
    found = np.zeros((0, 3))
    while len(found) < POINTS:
        points = rng.uniform(low, high, (POINTS, 3))
        distances, _ = solid.exact(points)
        found = np.concatenate([found, points[(distances < 0) & (distances > -BAND)]])
    return found[:POINTS]


def places(solid: Solid) -> Array:
    """Where the ball's centre is: over points spread on the mesh, so deep that its surface reaches `PRESSED` inside."""
    on_surface, _ = mesh_surface(solid.mesh, count=PLACES)
    distances, normals = solid.exact(on_surface - 1e-9)
    if solid.rounding:  # those at the sharp edges lie outside
        on_surface = on_surface - distances[:, None] * normals
    centers = on_surface + (BALL - PRESSED) * normals
    reached: Array = centers[np.abs(solid.exact(centers)[0] - (BALL - PRESSED)) < 1e-4]
    return reached


def force_errors(solid: Solid, grid: DistanceGrid) -> tuple[float, float, float]:
    """Of the force on the ball, relative to the exact one: median, root mean square, worst."""
    ball, across = capsule(BALL, 0.0, count=POINTS_ON_BALL)
    areas = across.sum(1)
    spec, shape = spec_with("grid", (1, 0, 0), grid=grid)
    stiffness = 1e7  # [N/m³]
    spec.add_contact("press", spec.add_points("ball", 0, ball, areas), shape, kn=stiffness, kt=0.0, mu=0.0, kd=0.0)
    at = places(solid)
    sim = Simulator(_core.Model(spec), num_envs=len(at), threads=1)
    sim.q[:] = at
    ours = sim.wrenches()[:, 0, 3:]
    errors = []
    for center, force in zip(at, ours, strict=True):
        distances, normals = solid.exact(ball + center)
        right = (stiffness * areas * np.maximum(-distances, 0)) @ normals
        errors.append(np.linalg.norm(force - right) / np.linalg.norm(right))
    return float(np.median(errors)), float(np.sqrt(np.mean(np.square(errors)))), float(np.max(errors))


def measure(solid: Solid, resolution: int, points: Array) -> tuple[Result, DistanceGrid]:
    begin = time.perf_counter()
    grid = build_grid(solid.mesh, solid.name, resolution=resolution, rounding=solid.rounding)
    seconds = time.perf_counter() - begin
    exact_distances, exact_normals = solid.exact(points)
    model = _core.Model(spec_with("grid", (1, 0, 0), grid=grid)[0])
    distances, normals, _ = model.distance("shape", points)
    wrong = np.linalg.norm(normals - exact_normals, axis=1)
    pairs = [
        (float(np.sqrt(np.mean(np.square(error)))), float(np.abs(error).max()))
        for error in (distances - exact_distances, wrong, np.linalg.norm(normals, axis=1) - 1)
    ]
    (d_rms, d_worst), (n_rms, n_worst), (l_rms, l_worst) = pairs
    forces = force_errors(solid, grid)
    result = Result(
        solid.name, resolution, grid.spacing, d_rms, d_worst, n_rms, n_worst, l_rms, l_worst, *forces, seconds,
        grid.nbytes,
    )  # fmt: skip
    return result, grid


def microseconds_per_point(kind: str, grid: DistanceGrid | None, repeats: int) -> dict[str, float]:
    """One touching point in one evaluation of a step's forces with derivatives, and in a reading of markers.

    A block of points stands inside the shape; the difference between many points and few is what they cost. The
    fastest of the repeats counts.
    """
    seconds = {}
    for count in (200, 5000):
        line = np.random.default_rng(0).uniform(-1, 1, (count, 3)) * (0.01, 0.01, 1e-3) + (0, 0, 0.0085)
        spec, shape = spec_with(kind, (1, 0, 0) if grid is not None else SIZES["box"], grid=grid)
        numbers = {"kn": 1e-3, "kt": 1e-3, "mu": 0.5, "kd": 0.0}
        spec.add_contact("press", spec.add_points("line", 0, line, np.ones(count)), shape, **numbers)
        axes = [np.tile(axis, (count, 1)) for axis in np.eye(3)]
        spec.add_pad("pad", 0, line, *axes, shapes=[shape], **numbers)
        sim = Simulator(_core.Model(spec), threads=1)
        for what, work in (("step", lambda sim=sim: sim.step(np.zeros(0))), ("reading", sim.tactile)):
            times = []
            for _ in range(repeats):
                sim.reset()
                begin = time.perf_counter()
                work()
                times.append(time.perf_counter() - begin)
            evaluations = int(sim.iterations[0]) + 1  # of the forces; a reading is one
            seconds[what, count] = min(times) / evaluations
    return {what: (seconds[what, 5000] - seconds[what, 200]) / 4800 * 1e6 for what in ("step", "reading")}


def short(number: float, digits: int = 2) -> str:
    """So many digits, without an exponent where that is shorter."""
    if number >= 10:
        return f"{number:.0f}"
    return f"{number:.{digits}g}" if number >= 1e-3 else f"{number:.0e}".replace("e-0", "e-")


def table(results: list[Result]) -> Table:
    made = Table(
        title="errors: root mean square / worst; force: median / worst",
        title_justify="left",
        box=None,
        padding=(0, 1, 0, 0),
    )
    for column in ("solid", "cells", "distance µm", "normal", "‖n‖ − 1", "force %", "build s", "MB"):
        made.add_column(column, justify="left" if column == "solid" else "right", no_wrap=True)
    for r in results:
        made.add_row(
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
            made.add_row()
    return made


def draw(results: list[Result], file: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, 3, figsize=(11, 3.6), layout="constrained")
    lines = (
        ("distance [µm]", "distance_rms", 1e6),
        ("normal", "normal_rms", 1.0),
        ("contact force [%], median", "force_median", 100),
    )
    for panel, (title, field, scale) in zip(panels, lines, strict=True):
        for name in dict.fromkeys(r.solid for r in results):
            own = [r for r in results if r.solid == name]
            panel.loglog([r.resolution for r in own], [getattr(r, field) * scale for r in own], "o-", label=name)
        panel.set_xticks(RESOLUTIONS, [str(n) for n in RESOLUTIONS])
        panel.minorticks_off()
        panel.set(title=f"error of the {title}", xlabel="cells along the longest side")
        panel.grid(alpha=0.3)
    panels[0].legend(fontsize="small")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=110)


def main() -> int:
    parser = argparse.ArgumentParser(description="Measure distance grids of meshes against exact solids.")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks/results/mesh_distance.json", metavar="FILE")
    parser.add_argument("--picture", type=Path, default=ROOT / "docs/pictures/mesh_distance.png", metavar="FILE")
    parser.add_argument("--repeats", type=int, default=200, metavar="N", help="timed repeats (%(default)s)")
    args = parser.parse_args()
    console = Console(width=80)
    results, times = [], {}
    try:
        work = [(s, n) for s in solids() for n in RESOLUTIONS if s.rounding >= 2 * 0.06 / n or not s.rounding]
        points = {s.name: inside(s, np.random.default_rng(0)) for s, _ in work}
        for solid, resolution in track(work, "grids", console=Console(stderr=True), transient=True):
            result, grid = measure(solid, resolution, points[solid.name])
            results.append(result)
            if solid.name == "box":
                times[str(resolution)] = microseconds_per_point("grid", grid, args.repeats)
    except GelflowError as error:
        print(error, file=sys.stderr)
        return 2
    times["exact box"] = microseconds_per_point("box", None, args.repeats)
    console.print(table(results))
    cost = Table(title="µs per touching point", title_justify="left")
    for column in ("", "force and derivatives", "reading"):
        cost.add_column(column, justify="right")
    for name, t in times.items():
        cost.add_row(name if name == "exact box" else f"{name} cells", f"{t['step']:.3f}", f"{t['reading']:.3f}")
    console.print(cost)
    record = {
        "format": 1,
        "processor": processor(),
        "band": BAND,
        "results": [dataclasses.asdict(r) for r in results],
        "microseconds_per_point": times,
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    draw(results, args.picture)
    print(args.out, args.picture, sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
