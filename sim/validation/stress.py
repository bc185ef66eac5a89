"""Stress test: random steps far outside the normal range of the scenes, with failure counts and costs.

A batch has one scene, friction law, integrator, precision and time step; parameters, start and controls are sampled per
environment. Kinds of batches:

* normal: the reference motion with steps of 1 to 10 ms; stiffness, friction, damping and masses scaled by 1/3 to 3;
  initial velocities up to 0.1 m/s or rad/s
* one extreme quantity, the rest normal:

  =========  ========================================================================================
  stiffness  k_n and k_s 1e-2 to 1e9 N/m
  damping    k_t 1e-3 to 1e6 N s/m; k_d and servos' damping 0, or 1e-3 to 1e6
  friction   µ 0, 1e6, or 1e-2 to 10
  mass       of each body 1e-4 to 1e4 times the scene's: ratios to 1e8
  speed      initial velocities 1e-3 to 100 m/s or rad/s; controls plus 0.01 to 10 times a random vector
  step       1e-6 to 5e-2 s
  =========  ========================================================================================

* all quantities extreme

Ranges of more than a decade are uniform in the logarithm. A failed environment does not move for the rest of its batch
and is not counted further.
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
    """Counts over a number of steps."""

    steps: int = 0
    failed: int = 0
    halved: int = 0  # steps that were split into substeps
    iterations: int = 0
    most_iterations: int = 0  # largest number of iterations of a step
    reasons: dict[int, int] = field(default_factory=dict)  # status → number of environments

    def add(self, other: "StepStatistics") -> None:
        """Add the counts of other steps."""
        for name in ("steps", "failed", "halved", "iterations"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.most_iterations = max(self.most_iterations, other.most_iterations)
        for status, count in other.reasons.items():
            self.reasons[status] = self.reasons.get(status, 0) + count


@dataclass(frozen=True)
class StressBatch:
    """Settings that are common to the environments of a batch."""

    scene: str
    law: str
    integrator: str
    kind: str  # one of `KINDS`
    precision: Precision = "double"


def stress_batches(rounds: int) -> list[StressBatch]:
    """`rounds` batches of every scene, law and integrator.

    Of 10 batches 2 are normal, 4 have one extreme quantity and 4 all; every fifth is in single precision.
    """
    kinds = [k for i in range(len(QUANTITIES)) for k in ("all", QUANTITIES[i], "normal", QUANTITIES[i - 1], "all")]
    combinations = list(product(SCENES, FRICTION_LAWS, INTEGRATORS))
    result = []
    for i in range(rounds):
        for j, (scene, law, integrator) in enumerate(combinations):
            precision: Precision = "single" if (i + j) % 5 == 0 else "double"
            result.append(StressBatch(scene, law, integrator, kinds[(i + 7 * j) % len(kinds)], precision))
    return result


class StressTest:
    """Samples and runs batches; scenes are loaded once."""

    def __init__(self, *, envs: int = 100, steps: int = 20, threads: int | None = None, seed: int = 0) -> None:
        self.envs, self.steps, self.threads = envs, steps, threads
        self._rng = np.random.default_rng(seed)
        self._scenes: dict[tuple[str, str, str], Scene] = {}

    def start(self, batch: StressBatch) -> tuple[Simulator, Array]:
        """Simulator of a batch at its start, and controls (steps, envs, nu)."""
        rng, n = self._rng, self.envs
        scene = self._scene(batch)
        extreme = set(QUANTITIES) if batch.kind == "all" else {batch.kind}
        spec = scene.model_spec()
        spec.step = float(self._log(1e-6, 5e-2, 1)[0] if "step" in extreme else self._log(1e-3, 1e-2, 1)[0])
        sim = Simulator(_core.Model(spec), num_envs=n, precision=batch.precision, threads=self.threads)
        for i, name in enumerate(sim.model.param_names):
            self._sample_parameter(name.rsplit(".", 1)[-1], sim.params[:, i], extreme)
        run = reference_motion(scene)
        sim.q[:] = run.q0
        u = np.repeat(run.controls(spec.step * np.arange(1, self.steps + 1))[:, None], n, axis=1)
        if "speed" in extreme:
            sim.v[:] = rng.normal(size=sim.v.shape) * self._log(1e-3, 100, n)[:, None]
            u += rng.normal(size=u.shape) * self._log(1e-2, 10, self.steps * n).reshape(self.steps, n, 1)
        else:
            sim.v[:] = rng.uniform(-0.1, 0.1, sim.v.shape)
        return sim, u

    def run(self, batch: StressBatch) -> StepStatistics:
        """Take the steps of a batch. Raises SimulationError for results that are not finite."""
        sim, u = self.start(batch)
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
                raise SimulationError(f"results of {batch} are not finite")
        statistics.failed = int((sim.status != 0).sum())
        statistics.halved = int(sim.halved.sum())
        statistics.reasons = {int(s): int((sim.status == s).sum()) for s in np.unique(sim.status) if s}
        return statistics

    def _scene(self, batch: StressBatch) -> Scene:
        key = (batch.scene, batch.law, batch.integrator)
        if key not in self._scenes:
            overrides: dict[str, Any] = {"integrator": batch.integrator, **_FEW_MARKERS.get(batch.scene, {})}
            self._scenes[key] = load_scene(batch.scene, friction=batch.law, overrides=overrides)
        return self._scenes[key]

    def _log(self, low: float, high: float, count: int) -> Array:
        return np.exp(self._rng.uniform(np.log(low), np.log(high), count))

    def _sample_parameter(self, kind: str, values: NDArray[Any], extreme: set[str]) -> None:
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
