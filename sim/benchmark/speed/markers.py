"""Cost of a marker: evaluation of tactile forces with all markers in contact, and its reverse pass."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gelflow.measurement.timing import BenchmarkOptions, Report, Timing, Workload, load_note, time_interleaved
from gelflow.sim import _core
from gelflow.sim.benchmark.speed.timed_run import FORCE
from gelflow.sim.scene.geometry.distance_grid import spline_grid
from gelflow.sim.scene.model_spec import core_grid
from gelflow.sim.simulator import Simulator

Array = NDArray[np.float64]
Precision = Literal["double", "single"]

# kind → sizes [m], and height of the top above the centre [m]. The pad is pressed into the top.
SHAPES: dict[str, tuple[tuple[float, float, float], float]] = {
    "sphere": ((0.02, 0.0, 0.0), 0.02),
    "plane": ((0.0, 0.0, 0.0), 0.0),
    "box": ((0.03, 0.02, 0.01), 0.01),
    "cylinder": ((0.02, 0.03, 0.0), 0.03),
    "capsule": ((0.015, 0.03, 0.0), 0.045),
    "ellipsoid": ((0.03, 0.02, 0.012), 0.012),
    "rounded box": ((0.03, 0.02, 0.01), 0.01),
    "grid": ((1.0, 1.0, 1.0), 0.02),
}
ROUNDING = 2e-3  # [m]
CELLS = 64  # of the distance grid along the diameter of its ball
SIDE, QUICK_SIDE = 200, 50
PAD, DEPTH = 4e-3, 1e-3  # side of the pad, depth of its centre [m]
PRECISIONS: tuple[Precision, ...] = ("double", "single")
GRADIENT = 1e-3  # largest relative difference between the gradients in single and double precision


def ball_grid(radius: float) -> _core.DistanceGrid:
    """Signed distance grid of a ball."""
    spacing = 2 * radius / CELLS
    nodes = spacing * np.arange(-CELLS // 2 - 3, CELLS // 2 + 4)
    distances = np.sqrt(sum(np.meshgrid(nodes**2, nodes**2, nodes**2, indexing="ij"))) - radius
    return core_grid(spline_grid(distances, np.full(3, nodes[0]), spacing))


def pressed_pad(kind: str, side: int) -> _core.Model:
    """Model of a square pad with side × side markers, on slides along x and z, pressed into the top of a shape."""
    spec = _core.ModelSpec()
    size, top = SHAPES[kind]
    extra: dict[str, Any] = {"rounding": ROUNDING} if kind == "rounded box" else {}
    extra |= {"grid": ball_grid(top)} if kind == "grid" else {}
    core_kind = "box" if kind == "rounded box" else kind
    shape = spec.add_shape(_core.ShapeDef(name="shape", kind=core_kind, size=size, **extra))
    body = spec.add_body(
        _core.BodyDef(name="pad", pos=(0, 0, top - DEPTH), mass=0.1, inertia=(1e-5, 1e-5, 1e-5, 0, 0, 0))
    )
    for name, axis in (("x", (1, 0, 0)), ("z", (0, 0, 1))):
        spec.add_joint(_core.JointDef(name=name, body=body, type="slide", axis=axis))
    at = PAD * ((np.arange(side) + 0.5) / side - 0.5)
    positions = np.stack([*np.meshgrid(at, at, indexing="ij"), np.zeros((side, side))], axis=-1).reshape(-1, 3)
    axes = [np.tile(axis, (side**2, 1)) for axis in ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))]
    numbers: dict[str, Any] = {"kn": 1.0, "kt": 0.01, "mu": 2.0, "kd": 0.003}
    spec.add_pad(
        _core.PadDef(
            name="pad",
            body=body,
            positions=positions,
            axes=np.stack(axes, axis=-1),
            shapes=[shape],
            law="viscous",
            **numbers,
        )
    )
    return _core.Model(spec)


@dataclass
class _PressedPad:
    """The pad on one shape, in one precision."""

    kind: str
    precision: Precision
    sim: Simulator

    def __post_init__(self) -> None:
        self.sim.v[:] = 0.01  # the markers slide and move inwards
        rng = np.random.default_rng(0)
        self.forces = self.sim.tactile()
        self._still = self.sim.rollout(np.zeros((0, 1, self.sim.model.nu)), read_after=(0,))
        self._by = rng.normal(size=self._still.tactile.shape).astype(self.sim.dtype)

    def gradient(self) -> Array:
        """Gradient of a randomly weighted sum of the forces with respect to positions and velocities, (4,)."""
        found = self.sim.rollout_gradient(self._still, tactile=self._by)
        return np.concatenate([found.q[0], found.v[0]]).astype(float)

    def workloads(self) -> Iterator[Workload]:
        markers = int(self.sim.model.num_markers)
        yield Workload(self.sim.tactile, markers)
        yield Workload(self.gradient, markers)


def measure_markers(options: BenchmarkOptions, *, side: int | None = None) -> Report:
    """Time the forces of side × side markers, all in contact, on every shape and in both precisions."""
    side = side or (QUICK_SIDE if options.quick else SIDE)
    models = {kind: pressed_pad(kind, side) for kind in SHAPES}
    pads = [
        _PressedPad(kind, precision, Simulator(model, threads=1, precision=precision))
        for kind, model in models.items()
        for precision in PRECISIONS
    ]
    workloads = [work for pad in pads for work in pad.workloads()]
    options.progress.begin("markers", len(workloads) * (options.repeats + 1))
    timings = time_interleaved(workloads, options)
    rows, results, violations = [], [], []
    for i, kind in enumerate(SHAPES):
        double, single = pads[2 * i : 2 * i + 2]
        times = dict(zip(("double", "double_gradient", "single", "single_gradient"), timings[4 * i :], strict=False))
        result = _compared(double, single) | {name: time.to_dict() for name, time in times.items()}
        results.append({"shape": kind, "markers": side**2} | result)
        rows.append((kind, *_nanoseconds(times), f"{result['touching']:.0%}"))
        if result["touching"] < 1 or not result["force_off"] <= FORCE or not result["gradient_off"] <= GRADIENT:
            violations.append(
                f"markers, {kind}: {result['touching']:.1%} in contact; single precision differs from double by "
                f"{result['force_off']:.1e} in the forces and {result['gradient_off']:.1e} in the gradient; allowed: "
                f"100 %, {FORCE:g} and {GRADIENT:g}"
            )
    return Report(
        name="markers",
        title=f"Tactile forces of {side} × {side} markers, all in contact: ns per marker",
        columns=("shape", "double", "+ gradient", "ratio", "single", "+ gradient", "ratio", "contact"),
        rows=rows,
        note="One thread, viscous friction. + gradient: with the reverse pass. ratio: of the two. contact: share of "
        "markers in contact." + load_note(timings),
        results=results,
        violations=violations,
    )


def _nanoseconds(times: dict[str, Timing]) -> Iterator[str]:
    for precision in PRECISIONS:
        value, gradient = times[precision].median, times[f"{precision}_gradient"].median
        yield from (f"{value * 1e9:.2f}", f"{(value + gradient) * 1e9:.2f}", f"{(value + gradient) / value:.1f}")


def _compared(double: _PressedPad, single: _PressedPad) -> dict[str, Any]:
    """Share of markers in contact, total force, and relative differences between the precisions."""
    apart = [
        float(np.linalg.norm(one - other) / np.linalg.norm(other))
        for one, other in ((single.forces, double.forces), (single.gradient(), double.gradient()))
    ]
    return {
        "touching": float((double.forces[0, :, 2] > 0).mean()),
        "force_sum": double.forces[0].sum(0).tolist(),
        "force_off": apart[0],
        "gradient_off": apart[1],
    }
