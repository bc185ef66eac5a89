"""Random steps far outside what scenes are made for: how often the simulator gives up, and what it costs.

Steps are drawn in batches of one scene, friction law, integrator, precision and time step; each environment has its own
parameters, start and controls. A batch is of one of these kinds:

* normal: the motion of `reference_motions`, steps of 1 to 10 ms; stiffness, friction, damping and masses from a third
  to three times the scene's; every velocity of the start is off by up to 0.1 (m/s or rad/s)
* one quantity extreme, the rest normal:

  =========  ========================================================================================
  stiffness  k_n and k_s 1e-2 to 1e9 N/m
  damping    k_t 1e-3 to 1e6 N s/m; k_d and servos' damping 0, or 1e-3 to 1e6
  friction   µ 0, 1e6, or 1e-2 to 10
  mass       of each body 1e-4 to 1e4 times the scene's: ratios to 1e8
  speed      velocities of the start 1e-3 to 100 m/s or rad/s; controls off by 0.01 to 10 times a random direction
  step       1e-6 to 5e-2 s
  =========  ========================================================================================

* all of them at once

Numbers over more than a decade are uniform in their logarithm. An environment that fails stands still for the rest of
its batch and counts no more.
"""

from dataclasses import dataclass, field
from itertools import product
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import SimulationError
from gelflow.sim import _core
from gelflow.sim.scene import FRICTION_LAWS, INTEGRATORS, Scene, load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.reference_motions import SCENES, reference_motion

Array = NDArray[np.float64]
Precision = Literal["double", "single"]

QUANTITIES = ("stiffness", "damping", "friction", "mass", "speed", "step")
KINDS = ("normal", *QUANTITIES, "all")
_FEW_MARKERS = {"rolling": {"pads.pad.rows": 10, "pads.pad.cols": 10}}


@dataclass
class StepStatistics:
    """What a number of steps came to."""

    steps: int = 0
    failed: int = 0
    halved: int = 0  # steps that were taken as substeps
    iterations: int = 0
    most_iterations: int = 0  # of one step
    reasons: dict[int, int] = field(default_factory=dict)  # status: how many

    def add(self, other: "StepStatistics") -> None:
        for name in ("steps", "failed", "halved", "iterations"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.most_iterations = max(self.most_iterations, other.most_iterations)
        for status, count in other.reasons.items():
            self.reasons[status] = self.reasons.get(status, 0) + count


@dataclass(frozen=True)
class StressBatch:
    """One batch: everything that is the same for its environments."""

    scene: str
    law: str
    integrator: str
    kind: str  # of `KINDS`
    precision: Precision = "double"


def stress_batches(rounds: int) -> list[StressBatch]:
    """Every scene × law × integrator `rounds` times: 2 of 10 normal, 4 with one extreme quantity, 4 with all; every
    fifth in single precision."""
    kinds = [k for i in range(len(QUANTITIES)) for k in ("all", QUANTITIES[i], "normal", QUANTITIES[i - 1], "all")]
    combinations = list(product(SCENES, FRICTION_LAWS, INTEGRATORS))
    result = []
    for i in range(rounds):
        for j, (scene, law, integrator) in enumerate(combinations):
            precision: Precision = "single" if (i + j) % 5 == 0 else "double"
            result.append(StressBatch(scene, law, integrator, kinds[(i + 7 * j) % len(kinds)], precision))
    return result


class StressTest:
    """Draws and runs batches; scenes are loaded once."""

    def __init__(self, *, envs: int = 100, steps: int = 20, threads: int | None = None, seed: int = 0) -> None:
        self.envs, self.steps, self.threads = envs, steps, threads
        self._rng = np.random.default_rng(seed)
        self._scenes: dict[tuple[str, str, str], Scene] = {}

    def start(self, draw: StressBatch) -> tuple[Simulator, Array]:
        """A batch at its start, and its controls (steps, envs, nu)."""
        rng, n = self._rng, self.envs
        scene = self._scene(draw)
        extreme = set(QUANTITIES) if draw.kind == "all" else {draw.kind}
        spec = scene.describe_to(_core.ModelSpec())
        spec.step = float(self._log(1e-6, 5e-2, 1)[0] if "step" in extreme else self._log(1e-3, 1e-2, 1)[0])
        sim = Simulator(_core.Model(spec), num_envs=n, precision=draw.precision, threads=self.threads)
        for i, name in enumerate(sim.model.param_names):
            self._draw_parameter(name.rsplit(".", 1)[-1], sim.params[:, i], extreme)
        run = reference_motion(scene)
        sim.q[:] = run.q0
        u = np.repeat(run.controls(spec.step * np.arange(1, self.steps + 1))[:, None], n, axis=1)
        if "speed" in extreme:
            sim.v[:] = rng.normal(size=sim.v.shape) * self._log(1e-3, 100, n)[:, None]
            u += rng.normal(size=u.shape) * self._log(1e-2, 10, self.steps * n).reshape(self.steps, n, 1)
        else:
            sim.v[:] = rng.uniform(-0.1, 0.1, sim.v.shape)
        return sim, u

    def run(self, draw: StressBatch) -> StepStatistics:
        """Take the steps of a batch. Raises SimulationError where anything but finite numbers comes out."""
        sim, u = self.start(draw)
        statistics = StepStatistics()
        for control in u:
            alive = sim.status == 0
            before = sim.iterations[alive].copy()
            sim.step(control)
            used = sim.iterations[alive] - before
            statistics.steps += int(alive.sum())
            statistics.iterations += int(used.sum())
            statistics.most_iterations = max(statistics.most_iterations, int(used.max(initial=0)))
        for values in (sim.q, sim.v, sim.anchors, sim.history, sim.tactile()):
            if not np.isfinite(values).all():
                raise SimulationError(f"numbers that are not finite came out of {draw}")
        statistics.failed = int((sim.status != 0).sum())
        statistics.halved = int(sim.halved.sum())
        statistics.reasons = {int(s): int((sim.status == s).sum()) for s in np.unique(sim.status) if s}
        return statistics

    def _scene(self, draw: StressBatch) -> Scene:
        key = (draw.scene, draw.law, draw.integrator)
        if key not in self._scenes:
            overrides: dict[str, Any] = {"integrator": draw.integrator, **_FEW_MARKERS.get(draw.scene, {})}
            self._scenes[key] = load_scene(draw.scene, friction=draw.law, overrides=overrides)
        return self._scenes[key]

    def _log(self, low: float, high: float, count: int) -> Array:
        return np.exp(self._rng.uniform(np.log(low), np.log(high), count))

    def _draw_parameter(self, kind: str, values: NDArray[Any], extreme: set[str]) -> None:
        rng, n, base = self._rng, len(values), float(values[0])
        quantity = {"kn": "stiffness", "ks": "stiffness", "kt": "damping", "kd": "damping", "mu": "friction"}.get(kind)
        if kind == "mass":
            values *= self._log(1e-4, 1e4, n) if "mass" in extreme else self._log(1 / 3, 3, n)
        elif quantity is None:
            return
        elif quantity not in extreme:
            values *= self._log(1 / 3, 3, n)
        elif quantity == "stiffness":
            values[:] = self._log(1e-2, 1e9, n) if base > 0 else 0
        elif quantity == "friction":
            values[:] = rng.choice([0.0, 1e6, 1.0], n, p=[0.1, 0.1, 0.8]) * self._log(1e-2, 10, n)
        else:
            none = 0.2 if kind == "kd" else 0.0
            values[:] = np.where(rng.random(n) < none, 0, self._log(1e-3, 1e6, n))
