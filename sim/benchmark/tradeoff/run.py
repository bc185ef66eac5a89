"""One scene's motion as a user steps and reads it: what came of it, how far off that is, and what it took.

Whatever the time step, controls are those of the motion every 10 ms, and markers are read then, or at every second,
fourth, … of these times; in between a user has the last reading in hand. So all settings solve one and the same
problem, and one call of the core steps from one reading to the next.
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

FRAME = 10e-3  # between two controls, and at least between two readings [s]
DRAWN = 1.5  # stiffness, friction and masses are drawn up to this many times larger or smaller
WINDOW = 8  # frames before the look: over which the loss is, and by whose controls it is differentiated
_FLOOR = 0.1  # of a run's largest shear, see `_flow`
_STATE = ("q", "v", "anchors", "anchored", "history")


@dataclass(frozen=True)
class Run:
    """What one run came to, at the start and after each frame."""

    poses: Array  # of all bodies (frames + 1, bodies, 7)
    field: Array  # what the markers felt when last read, over their weights (frames + 1, markers, 3)
    gradient: Array | None  # of the tactile loss by the controls, times their spread (WINDOW, controls that change)
    look: int  # frame of the motion's look
    iterations: int  # of Newton's method
    halved: int  # steps that had to be halved


@dataclass(frozen=True)
class Errors:
    """How far a run is off, at most over all frames where nothing else is said."""

    position: float  # of any body [m]
    rotation: float  # of any body [rad]
    markers: float  # of the marker field, over all frames: ‖T − T*‖ / ‖T*‖
    flow: float  # endpoint error of the flow map at the look: mean length of what its vectors are off; the longest is 1
    cosine: float  # between the gradients of the tactile loss by all controls
    gradient: float  # of that gradient: ‖g − g*‖ / ‖g*‖

    def worst(self, other: "Errors") -> "Errors":
        """Of both, the worse in each figure."""
        pairs = {name: (mine, vars(other)[name]) for name, mine in vars(self).items()}
        return Errors(**{name: min(pair) if name == "cosine" else max(pair) for name, pair in pairs.items()})


class Task:
    """A scene's motion, ready to be run again and again.

    Parameters
    ----------
    scene: one with a motion; its step must divide 10 ms
    every: markers are read after every so many frames

    Raises UsageError when the step does not divide a frame.
    """

    def __init__(self, scene: Scene, *, every: int = 1) -> None:
        self.scene, self.every = scene, every
        self.steps = round(FRAME / scene.step)
        if self.steps < 1 or abs(self.steps * scene.step - FRAME) > 1e-9 * FRAME:
            raise UsageError(f"{scene.path}: a step of {scene.step} s must divide {FRAME} s, the time between controls")
        self.sim = Simulator(scene, threads=1)
        self.motion = reference_motion(scene)
        self.look = round(self.motion.evaluation_time / FRAME)
        self.controls: NDArray[Any] = self.motion.step_controls(FRAME).astype(self.sim.dtype)[:, None]
        weights = np.concatenate([np.broadcast_to(p.weights, len(p.positions)) for p in scene.pads])
        self._weights = weights[:, None]

    def seconds(self) -> float:
        """Run once, for the processor's time that stepping and reading take [s]: what else runs here counts less so.

        Raises SimulationError where a step can't be taken.
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

    def run(self, *, onto: Scene | None = None, gradient: bool = True) -> Run:
        """Run once, for what comes of it; the marker field on the markers of `onto`.

        Raises SimulationError where a step can't be taken.
        """
        sim = self._at_start()
        iterations, halved = int(sim.iterations[0]), int(sim.halved[0])
        poses, fields, starts = [sim.poses()[0].copy()], [self._read()], {}
        for frame, u in enumerate(self.controls, 1):
            if gradient and 0 <= self.look - frame < WINDOW:
                starts[frame] = {name: np.array(getattr(sim, name)) for name in _STATE}
            sim.step(u, self.steps)
            poses.append(sim.poses()[0].copy())
            fields.append(self._read() if frame % self.every == 0 else fields[-1])
        sim.check()
        return Run(
            poses=np.array(poses, float),
            field=np.array(fields if onto is None else _resampled(fields, self.scene.pads, onto.pads)),
            gradient=self._gradient(starts, fields) if gradient else None,
            look=self.look,
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
        """Of the mean square of the field over the frames before the look, by the controls of the same frames.

        Frames are gone back over one by one, from the states at their starts: the whole trajectory of short steps would
        not fit into memory.
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
            held = min(self.every, self.look - frame + 1)
            felt = scale * held * fields[frame] / self._weights if reads else None
            at_end = {name: np.zeros(getattr(trajectory, name).shape) for name in ("q", "v")}
            for name, values in at_end.items():
                values[-1] = later.get(name, 0)
            back = sim.rollout_gradient(
                trajectory,
                q=at_end["q"],
                v=at_end["v"],
                tactile=felt,
                anchors_end=later.get("anchors"),
                history_end=later.get("history"),
            )
            rows.insert(0, back.u.sum((0, 1)))
            later = {name: getattr(back, name) for name in ("q", "v", "anchors", "history")}
        spread = self.motion.step_controls(FRAME).std(0)
        return np.asarray(np.array(rows)[:, spread > 0] * spread[spread > 0], float)


def drawn(scene: Scene, rng: np.random.Generator) -> Scene:
    """The scene with another physics: stiffness (damping along with it) and friction of each contact and pad, and the
    mass of each body, times factors between 1/1.5 and 1.5. One state of `rng` gives one physics, whatever the step.

    Bodies with pads keep their mass: motions push them with forces that are meant for it."""

    def factor() -> float:
        return float(np.exp(rng.uniform(-1, 1) * np.log(DRAWN)))

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


def compare(run: Run, truth: Run) -> Errors:
    """How far a run is off the truth, both on the same markers. Gradients that were not asked for count as right."""
    shift = np.linalg.norm(run.poses[..., :3] - truth.poses[..., :3], axis=-1)
    flow = _flow(run, truth) - _flow(truth, truth)
    cosine, gradient = 1.0, 0.0
    if run.gradient is not None and truth.gradient is not None:
        sizes = float(np.linalg.norm(run.gradient) * np.linalg.norm(truth.gradient))
        cosine = float((run.gradient * truth.gradient).sum()) / sizes if sizes > 0 else 0.0
        gradient = _relative(run.gradient, truth.gradient)
    return Errors(
        position=float(shift.max()),
        rotation=float(angles_between(run.poses[..., 3:], truth.poses[..., 3:]).max()),
        markers=_relative(run.field[1:], truth.field[1:]),
        flow=float(np.linalg.norm(flow, axis=-1).mean()),
        cosine=cosine,
        gradient=gradient,
    )


def _relative(found: Array, true: Array) -> float:
    off, size = float(np.linalg.norm(found - true)), float(np.linalg.norm(true))
    return off / size if size > 0 else (0.0 if off == 0 else np.inf)


def _flow(run: Run, truth: Run) -> Array:
    """The vectors of the flow map at the look, against the start, (markers, 2).

    Where all forces of a scene are small, a tenth of the largest is the floor, instead of the noise of a real sensor.
    """
    shear = np.linalg.norm(truth.field[..., :2] - truth.field[0, :, :2], axis=-1)
    floor = min(MIN_DIVISORS["N"], _FLOOR * float(shear.max()))
    one = (1, -1, 1, 2)  # sensors, rows, columns: how markers are arranged makes no difference to the vectors
    image, _ = normalize(
        run.field[truth.look, :, :2].reshape(1, *one), run.field[0, :, :2].reshape(one), min_divisor=floor
    )
    return np.asarray(image).reshape(2, -1).T


def _resampled(fields: Sequence[Array], pads: Sequence[PadDef], onto: Sequence[PadDef]) -> Array:
    """Fields on the markers of other pads: linear between four markers, nearest beyond the outermost."""
    parts, first = [], 0
    for pad, other in zip(pads, onto, strict=True):
        values = np.array([field[first : first + len(pad.positions)] for field in fields])
        first += len(pad.positions)
        if pad.grid is not None and other.grid is not None and pad.grid != other.grid:
            along = [
                (np.arange(n) - (n - 1) / 2) * pad.grid.pitch + middle
                for n, middle in zip((pad.grid.rows, pad.grid.cols), pad.grid.center, strict=True)
            ]
            by_place = values.reshape(len(fields), pad.grid.rows, pad.grid.cols, 3).transpose(1, 2, 0, 3)
            places = np.clip(other.grid.positions(), [a[0] for a in along], [a[-1] for a in along])
            values = RegularGridInterpolator(along, by_place)(places).transpose(1, 0, 2)
        parts.append(values)
    return np.concatenate(parts, axis=1)
