"""A scene's reference motion with given settings: results, errors relative to a reference, and computing time.

For every time step, controls change every 10 ms (a frame), and marker forces are evaluated every one, two, four, …
frames; in between the last forces are held. All settings therefore solve the same problem, with one call of the core
per frame.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from gelflow.errors import UsageError
from gelflow.geometry import angles_between
from gelflow.observation import MIN_DIVISORS, normalize
from gelflow.sim.scene import PadDef, Scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.reference_motions import reference_motion

Array = NDArray[np.float64]

FRAME = 10e-3  # interval of controls, and shortest interval of tactile forces [s]
SPREAD = 1.5  # largest factor of sampled stiffness, friction and masses
WINDOW = 8  # frames before the evaluation: those of the loss, and of the differentiated controls
_FLOOR = 0.1  # minimum divisor relative to the largest shear, see `_flow`
_STATE = ("q", "v", "anchors", "anchored", "history")


@dataclass(frozen=True)
class MotionResult:
    """Results of one motion, at the start and after each frame."""

    poses: Array  # of all bodies (frames + 1, bodies, 7)
    field: Array  # last evaluated marker forces over their weights (frames + 1, markers, 3)
    # Of the tactile loss with respect to controls, times their standard deviation (WINDOW, changing controls).
    gradient: Array | None
    evaluation_frame: int  # frame of the motion's evaluation time
    iterations: int  # Newton iterations
    halved: int  # steps that were split into substeps


@dataclass(frozen=True)
class Errors:
    """Errors relative to a reference; maxima over all frames unless stated otherwise."""

    position: float  # largest of any body [m]
    rotation: float  # largest of any body [rad]
    markers: float  # marker forces over all frames: ‖T − T*‖ / ‖T*‖
    flow: float  # mean endpoint error of the flow map at the evaluation time; the longest vector is 1
    cosine: float  # between the gradients of the tactile loss with respect to all controls
    gradient: float  # of that gradient: ‖g − g*‖ / ‖g*‖

    def worst(self, other: "Errors") -> "Errors":
        """The larger error in each quantity."""
        pairs = {name: (mine, vars(other)[name]) for name, mine in vars(self).items()}
        return Errors(**{name: min(pair) if name == "cosine" else max(pair) for name, pair in pairs.items()})


class MotionBenchmark:
    """The reference motion of a scene, for repeated runs.

    Parameters
    ----------
    scene: scene with a reference motion; its step must divide 10 ms
    every: frames between evaluations of marker forces

    Raises UsageError when the step does not divide a frame.
    """

    def __init__(self, scene: Scene, *, every: int = 1) -> None:
        self.scene, self.every = scene, every
        self.steps = round(FRAME / scene.step)
        if self.steps < 1 or abs(self.steps * scene.step - FRAME) > 1e-9 * FRAME:
            raise UsageError(f"{scene.path}: a step of {scene.step} s must divide {FRAME} s, the time between controls")
        self.sim = Simulator(scene, threads=1)
        self.motion = reference_motion(scene)
        self.evaluation_frame = round(self.motion.evaluation_time / FRAME)
        self.controls: NDArray[Any] = self.motion.step_controls(FRAME).astype(self.sim.dtype)[:, None]
        weights = np.concatenate([np.broadcast_to(p.weights, len(p.positions)) for p in scene.pads])
        self._weights = weights[:, None]

    def seconds(self) -> float:
        """Processor time of one run [s]; less sensitive to other processes than wall-clock time.

        Raises SimulationError when a step fails.
        """
        sim = self._at_start()
        begun = time.thread_time()
        for frame, u in enumerate(self.controls, 1):
            sim.step(u, self.steps)
            if frame % self.every == 0:
                sim.tactile()
        spent = time.thread_time() - begun
        sim.check()
        return spent

    def run(self, *, onto: Scene | None = None, gradient: bool = True) -> MotionResult:
        """Results of one run; with `onto`, marker forces are interpolated to the markers of that scene.

        Raises SimulationError when a step fails.
        """
        sim = self._at_start()
        iterations, halved = int(sim.iterations[0]), int(sim.halved[0])
        poses, fields, starts = [sim.poses()[0].copy()], [self._read()], {}
        for frame, u in enumerate(self.controls, 1):
            if gradient and 0 <= self.evaluation_frame - frame < WINDOW:
                starts[frame] = {name: np.array(getattr(sim, name)) for name in _STATE}
            sim.step(u, self.steps)
            poses.append(sim.poses()[0].copy())
            fields.append(self._read() if frame % self.every == 0 else fields[-1])
        sim.check()
        return MotionResult(
            poses=np.array(poses, float),
            field=np.array(fields if onto is None else _resampled(fields, self.scene.pads, onto.pads)),
            gradient=self._gradient(starts, fields) if gradient else None,
            evaluation_frame=self.evaluation_frame,
            iterations=int(sim.iterations[0]) - iterations,
            halved=int(sim.halved[0]) - halved,
        )

    def _at_start(self) -> Simulator:
        self.sim.reset()
        self.sim.q[0] = self.motion.q0
        return self.sim

    def _read(self) -> Array:
        return np.asarray(self.sim.tactile()[0] / self._weights, float)

    def _gradient(self, starts: Mapping[int, Mapping[str, NDArray[Any]]], fields: Sequence[Array]) -> Array:
        """Gradient of the mean square of the marker forces over the window, with respect to the controls in the window.

        The reverse pass goes frame by frame, from stored initial states, because the whole trajectory of short steps
        does not fit into memory.
        """
        sim = self.sim
        scale = 2 / (WINDOW * len(self._weights))
        rows: list[NDArray[Any]] = []
        later: dict[str, Any] = {}
        for frame in sorted(starts, reverse=True):
            reads = frame % self.every == 0
            u = np.repeat(self.controls[frame - 1 : frame], self.steps, axis=0)
            start: dict[str, Any] = {**starts[frame]}
            trajectory = sim.rollout(u, **start, read_after=(self.steps,) if reads else ())
            held = min(self.every, self.evaluation_frame - frame + 1)
            grad_tactile = scale * held * fields[frame] / self._weights if reads else None
            at_end = {name: np.zeros(getattr(trajectory, name).shape) for name in ("q", "v")}
            for name, values in at_end.items():
                values[-1] = later.get(name, 0)
            back = sim.rollout_gradient(
                trajectory,
                q=at_end["q"],
                v=at_end["v"],
                tactile=grad_tactile,
                anchors_end=later.get("anchors"),
                history_end=later.get("history"),
            )
            rows.insert(0, back.u.sum((0, 1)))
            later = {name: getattr(back, name) for name in ("q", "v", "anchors", "history")}
        spread = self.motion.step_controls(FRAME).std(0)
        return np.asarray(np.array(rows)[:, spread > 0] * spread[spread > 0], float)


def randomized(scene: Scene, rng: np.random.Generator) -> Scene:
    """The scene with sampled physics: stiffness and damping, friction, and masses times factors between 1/1.5 and 1.5.

    The sample depends on the state of `rng` only, not on the scene's settings. Bodies with pads keep their mass, for
    which the forces of the reference motions are chosen.
    """

    def factor() -> float:
        return float(np.exp(rng.uniform(-1, 1) * np.log(SPREAD)))

    def numbers(old: Mapping[str, float], stiffness: float, friction: float) -> dict[str, float]:
        return {name: value * (friction if name == "mu" else stiffness) for name, value in old.items()}

    groups = {group: (factor(), factor()) for group in dict.fromkeys(c.group for c in scene.contacts)}
    pads = [(factor(), factor()) for _ in scene.pads]
    with_pads = {pad.body for pad in scene.pads}
    masses = [1.0 if i in with_pads else factor() for i in range(len(scene.bodies))]
    return replace(
        scene,
        contacts=tuple(replace(c, params=numbers(c.params, *groups[c.group])) for c in scene.contacts),
        pads=tuple(replace(p, params=numbers(p.params, *two)) for p, two in zip(scene.pads, pads, strict=True)),
        bodies=tuple(
            replace(b, mass=b.mass * m, inertia=b.inertia * m) for b, m in zip(scene.bodies, masses, strict=True)
        ),
    )


def compare(run: MotionResult, reference: MotionResult) -> Errors:
    """Errors of a run relative to a reference on the same markers; a missing gradient has no error."""
    shift = np.linalg.norm(run.poses[..., :3] - reference.poses[..., :3], axis=-1)
    flow = _flow(run, reference) - _flow(reference, reference)
    cosine, gradient = 1.0, 0.0
    if run.gradient is not None and reference.gradient is not None:
        sizes = float(np.linalg.norm(run.gradient) * np.linalg.norm(reference.gradient))
        cosine = float((run.gradient * reference.gradient).sum()) / sizes if sizes > 0 else 0.0
        gradient = _relative(run.gradient, reference.gradient)
    return Errors(
        position=float(shift.max()),
        rotation=float(angles_between(run.poses[..., 3:], reference.poses[..., 3:]).max()),
        markers=_relative(run.field[1:], reference.field[1:]),
        flow=float(np.linalg.norm(flow, axis=-1).mean()),
        cosine=cosine,
        gradient=gradient,
    )


def _relative(found: Array, true: Array) -> float:
    off, size = float(np.linalg.norm(found - true)), float(np.linalg.norm(true))
    return off / size if size > 0 else (0.0 if off == 0 else np.inf)


def _flow(run: MotionResult, reference: MotionResult) -> Array:
    """The vectors of the flow map at the evaluation time, relative to the start of the motion, (markers, 2).

    The smallest divisor is that of `MIN_DIVISORS`, or a tenth of the largest shear where this is smaller.
    """
    shear = np.linalg.norm(reference.field[..., :2] - reference.field[0, :, :2], axis=-1)
    floor = min(MIN_DIVISORS["N"], _FLOOR * float(shear.max()))
    one = (1, -1, 1, 2)  # sensors, rows, columns: how markers are arranged makes no difference to the vectors
    evaluated, start = run.field[reference.evaluation_frame, :, :2], run.field[0, :, :2]
    image, _ = normalize(evaluated.reshape(1, *one), start.reshape(one), min_divisor=floor)
    return np.asarray(image).reshape(2, -1).T


def _resampled(fields: Sequence[Array], pads: Sequence[PadDef], onto: Sequence[PadDef]) -> Array:
    """Marker forces interpolated to other pads: bilinear, constant outside of the grid."""
    parts, first = [], 0
    for pad, other in zip(pads, onto, strict=True):
        values = np.array([field[first : first + len(pad.positions)] for field in fields])
        first += len(pad.positions)
        if pad.grid is not None and other.grid is not None and pad.grid != other.grid:
            along = [
                (np.arange(n) - (n - 1) / 2) * pad.grid.pitch + middle
                for n, middle in zip((pad.grid.rows, pad.grid.cols), pad.grid.center, strict=True)
            ]
            by_row = values.reshape(len(fields), pad.grid.rows, pad.grid.cols, 3).transpose(1, 2, 0, 3)
            positions = np.clip(other.grid.positions(), [a[0] for a in along], [a[-1] for a in along])
            values = RegularGridInterpolator(along, by_row)(positions).transpose(1, 0, 2)
        parts.append(values)
    return np.concatenate(parts, axis=1)
