"""The transfer matrix: worlds that differ from training in one thing, with the included policy, then fine-tuned.

Worlds are simulated, so that hundreds of insertions take seconds; policy and calibration do not use their values.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gelflow.errors import GelflowError
from gelflow.policies import recipes
from gelflow.policies.calibration.calibrated_randomization import calibrated_randomization
from gelflow.policies.calibration.calibration import Calibration, calibrate
from gelflow.policies.calibration.experiment.worlds import record_insertions
from gelflow.policies.calibration.fit import FitSettings
from gelflow.policies.checkpoint import default_checkpoint, load_checkpoint
from gelflow.policies.episodes import run_episodes
from gelflow.policies.evaluation import EvaluationResult
from gelflow.sim.tasks.gripper.pads import NOMINAL_PAD_VALUES
from gelflow.sim.tasks.insertion import insertion_scene
from gelflow.sim.tasks.insertion_randomization import FULL_RANDOMIZATION
from gelflow.sim.tasks.randomization import fixed_values
from gelflow.sim.tasks.registry import make_task
from gelflow.sim.tasks.sensor_model import NO_SENSOR_EFFECTS
from gelflow.task import INSERTION, InsertionTask

_SEED = 7  # of the evaluated insertions
_ENVS = 128
_TIGHT = (1e-3, 0.5e-3, 0.25e-3)  # gap beside the part on each side; that of training is 2.25 mm [m]

# A lab like that of the mock robot: the pads of the scene, an industrial arm, the noise of image tracking.
LAB: Mapping[str, float] = {
    **fixed_values(NO_SENSOR_EFFECTS),
    **NOMINAL_PAD_VALUES,
    "hole_kn": 7e3,
    "hole_mu": 0.8,
    "arm_stiffness": 1e5,
    "grasp_force": 10.0,
    "grasp_height": -2e-3,
    "stop_shear": 0.02,
    "noise": 1e-4,
    "start_height": 0.2e-3,
}


@dataclass(frozen=True)
class World:
    """One row of the matrix: what differs from `LAB`."""

    name: str
    values: Mapping[str, float] = field(default_factory=dict)  # of the randomization's quantities
    part: Mapping[str, Any] = field(default_factory=dict)  # of the part and its hole
    friction: str = "elastic"

    @property
    def task(self) -> InsertionTask:
        """The true part and hole."""
        return dataclasses.replace(INSERTION, part=dataclasses.replace(INSERTION.part, **self.part))


def worlds() -> tuple[World, ...]:
    """The rows of the matrix."""
    gel = {name: NOMINAL_PAD_VALUES[name] for name in ("pad_kn", "pad_ks", "marker_kn", "marker_ks")}
    length, width, height = INSERTION.part.size
    rows = [World("as the lab"), World("viscous shear law", friction="viscous")]
    rows += [World(f"gel stiffness × {k:g}", {name: k * v for name, v in gel.items()}) for k in (0.2, 0.5, 2, 5)]
    rows += [World(f"friction of pads and markers {mu:g}", {"pad_mu": mu, "marker_mu": mu}) for mu in (0.25, 0.5, 3)]
    rows += [World(f"friction of the hole {mu:g}", {"hole_mu": mu}) for mu in (0.1, 2.5)]
    rows += [World(f"stiffness of the hole {k / 1e3:g} N/mm", {"hole_kn": k}) for k in (1e3, 5e4)]
    rows += [World(f"arm stiffness {k / 1e3:g} N/mm", {"arm_stiffness": k}) for k in (70.0, 200.0, 1e3, 1e6)]
    rows += [World(f"gain of the right pad × {k:g}", {"gain_ratio": k}) for k in (0.5, 1.5, 2)]
    rows += [World("cameras turned by 6° and −6°", {"turn_left": 0.105, "turn_right": -0.105})]
    rows += [World(f"gel creep {c:g}, {t:g} s", {"gel_creep": c, "gel_time": t}) for c, t in ((0.3, 0.1), (0.6, 0.3))]
    rows += [World(f"crosstalk {c:g}", {"crosstalk": c}) for c in (0.3, 0.6)]
    rows += [World("10 % dead and 10 % noisy markers", {"dead_markers": 0.1, "noisy_markers": 0.1})]
    rows += [World(f"noise {1e3 * n:g} mN", {"noise": n}) for n in (1e-3, 3e-3)]
    rows += [World("drift 3 mN per reading", {"pad_drift": 3e-3})]
    rows += [World(f"grasp force {f:g} N", {"grasp_force": f}) for f in (1.0, 30.0)]
    rows += [World(f"grasp height {1e3 * h:g} mm", {"grasp_height": h}) for h in (-15e-3, 10e-3)]
    for change in (-0.3e-3, 0.3e-3):
        size = (length + change, width + change, height)
        clearance = tuple(c - change for c in INSERTION.part.clearance)  # the hole stays
        rows.append(World(f"part {1e3 * change:+g} mm", part={"size": size, "clearance": clearance}))
    rows += [World(f"clearance {1e3 * c:g} mm a side", part={"clearance": (2 * c, 2 * c)}) for c in _TIGHT]
    both = {**{name: 0.5 * v for name, v in gel.items()}, "pad_mu": 0.5, "marker_mu": 0.5, "hole_mu": 0.3}
    both |= {"arm_stiffness": 1e4, "gain_ratio": 1.5, "turn_left": 0.05, "gel_creep": 0.3, "crosstalk": 0.2}
    rows.append(World("soft gel, low friction, soft arm, unequal pads, creep, crosstalk", both))
    return tuple(rows)


def measure_world(
    world: World,
    folder: Path,
    *,
    episodes: int = 512,
    below: float = 0.9,
    settings: FitSettings | None = None,
    attempts: int | None = None,
    processes: int = 1,
) -> dict[str, Any]:
    """One row: success of the included policy, and after calibration and fine-tuning where it is lower than `below`.

    The calibration uses five insertions of the included policy; the fine-tuning, in `folder`, draws from the
    randomization that it has narrowed. Both know the true part and hole, as from a part file. `attempts` is the length
    of the fine-tuning, by default that of the recipe.
    """
    shipped = evaluate(default_checkpoint(), world, episodes)
    row: dict[str, Any] = {"world": world.name, "values": dict(world.values), "part": dict(world.part)}
    row |= {"friction": world.friction, "before": shipped.to_json()}
    if shipped.success >= below:
        return row
    try:
        result = _calibrated(world, settings, processes)
        randomization = calibrated_randomization(result)
        trained = recipes.train(
            "insertion", folder, recipe=recipes.FINE_TUNING, start=default_checkpoint(), steps=attempts,
            options={"task": world.task, **randomization},
        )  # fmt: skip
    except GelflowError as error:
        return row | {"refused": str(error)}
    after = evaluate(trained.checkpoint, world, episodes)
    verdicts = {e.parameter.name: e.verdict for e in result.estimates}
    drawn = {name: [min(values), max(values)] for name, values in randomization["samples"].items()}
    return row | {
        "ranges": randomization["ranges"],
        "drawn_between": drawn,
        "verdicts": verdicts,
        "minutes": trained.minutes,
        "after": after.to_json(),
    }


def _calibrated(world: World, settings: FitSettings | None, processes: int) -> Calibration:
    values = {**LAB, **world.values}
    rng = np.random.default_rng(_SEED)
    recorded = record_insertions(values, rng, task=world.task, friction=world.friction)
    return calibrate(recorded.recordings, settings=settings, processes=processes)


def evaluate(checkpoint: Path, world: World, episodes: int) -> EvaluationResult:
    """Success of an insertion policy in a world; the part may differ from that of the policy's training."""
    table = FULL_RANDOMIZATION.replace(**{**LAB, **world.values})
    scene = insertion_scene(world.task, friction=world.friction)
    envs = min(_ENVS, episodes)
    batch = make_task("insertion", envs, task=world.task, scene=scene, randomization=table, threads=1)
    stored = load_checkpoint(checkpoint)
    policy = stored.architecture.network(INSERTION, stored.tensors).batch_policy(envs)
    return run_episodes(policy, batch, episodes=episodes, seed=_SEED).result("policy")
