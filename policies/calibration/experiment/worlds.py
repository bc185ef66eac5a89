"""Random worlds with known truth, and insertions recorded in them by the simulated training environment."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.observation import FlowMap
from gelflow.policies.calibration.model.parameters import COMMANDED_FORCE, TAUGHT_HEIGHT, WIDENING
from gelflow.policies.calibration.model.reading_model import displacement_scale
from gelflow.policies.calibration.problem import in_hole
from gelflow.policies.calibration.recordings import Recordings
from gelflow.policies.checkpoint import default_checkpoint, load_network
from gelflow.policies.networks.flow_map_policy import FlowMapNetwork, NetworkPolicy
from gelflow.session.motion_plan import PlannedMotion
from gelflow.sim.tasks.insertion import DESCENT_SPEED, InsertionAttempts, insertion_scene
from gelflow.sim.tasks.insertion_randomization import FULL_RANDOMIZATION
from gelflow.sim.tasks.randomization import Fixed, LogUniform, Randomization, Uniform
from gelflow.task import INSERTION, InsertionTask

Array = NDArray[np.float64]

_AS_PUBLISHED = ("dead_markers", "noisy_markers", "crosstalk", "gel_creep", "gel_time", "start_height")  # not widened


def widened(table: Randomization) -> Randomization:
    """The table with ranges from a third of the lower limit to three times the upper one.

    The range of the grasp height becomes three times as wide, about its middle.
    """
    changes = {}
    for name in table:
        given = table[name].distribution
        if name in _AS_PUBLISHED or isinstance(given, Fixed):
            continue
        assert isinstance(given, Uniform | LogUniform)
        if name == "grasp_height":
            center, half = (given.low + given.high) / 2, WIDENING * (given.high - given.low) / 2
            changes[name] = (center - half, center + half)
        else:
            changes[name] = (given.low / WIDENING, given.high * WIDENING)
    return table.replace(**changes)


@dataclass(frozen=True)
class RecordedWorld:
    """Recordings of a world, and its true values, which the calibration does not see."""

    recordings: Recordings
    truth: dict[str, float]
    misalignment: Array  # (insertions, 3), of the recorded insertions
    noise: float  # standard deviation of the difference of two readings [N]
    heights: Array  # of the attempts' starts above the task's start height [m], (n,)


def record_world(seed: int, *, task: InsertionTask = INSERTION, plan: Sequence[PlannedMotion] = ()) -> RecordedWorld:
    """Insertions with the included policy in the world of a seed, which differs from training in all quantities.

    With a `plan` its motions are made on the first part instead. Raises UsageError when the world cannot hold its part,
    or no attempt has contact.
    """
    rng = np.random.default_rng((seed, 0xCA1))
    drawn = widened(FULL_RANDOMIZATION).sample(rng, 1, friction="elastic")
    return record_insertions({name: float(value[0]) for name, value in drawn.items()}, rng, task=task, plan=plan)


def record_insertions(
    fixed: Mapping[str, float],
    rng: np.random.Generator,
    *,
    task: InsertionTask = INSERTION,
    insertions: int = 5,
    attempts: int = 2,
    plan: Sequence[PlannedMotion] = (),
    **scene: Any,
) -> RecordedWorld:
    """Insertions with the included policy in a world; the first `attempts` of each are recorded.

    Parameters
    ----------
    fixed: value of every quantity of the randomization
    plan: motions that are made on the first part instead, all of them recorded
    task: part and hole, and the observations of the policy
    scene: options of `insertion_scene`, such as the friction law

    Raises UsageError as `record_world`.
    """
    table = FULL_RANDOMIZATION.replace(**fixed)
    world = InsertionAttempts(insertions, task=task, scene=insertion_scene(task, **scene), randomization=table)
    misalignment = task.draw_misalignment(rng, insertions)
    world.draw(rng, misalignment=misalignment)
    all_rows = np.arange(insertions)
    world.sensors.copy(all_rows, world.sensors, np.zeros_like(all_rows))  # the same pads in all insertions
    inserted: dict[int, Array] = {}
    if plan:
        rows = _planned(world, misalignment, plan, rng)
    else:
        rows, inserted = _with_policy(world, misalignment, attempts, rng)
    if not rows:
        raise UsageError("no attempt in this world has contact")
    kept = sorted({row[0] for row in rows})
    recordings = _recordings(rows, kept, task, inserted, fixed, rng, planned=bool(plan))
    depth = float(np.mean([row[2] for row in rows]))
    truth = _truth(fixed, world.sensors.gain[0], world.sensors.turn[0], depth)
    heights = np.array([row[4] for row in rows])
    return RecordedWorld(recordings, truth, misalignment[kept], float(np.sqrt(2) * fixed["noise"]), heights)


# Insertion, planar pose, depth [m], marker vectors, and start height above the task's [m] of an attempt.
_Row = tuple[int, Array, float, Array, float]


def _planned(
    world: InsertionAttempts, misalignment: Array, plan: Sequence[PlannedMotion], rng: np.random.Generator
) -> list[_Row]:
    """The motions of a plan on the first part; those that fall into the hole have no contact and are not recorded."""
    per_newton, drawn = displacement_scale(world.scene), float(world.stop_shear[0])
    rows = []
    for motion in plan:
        planar = np.array(motion.planar_pose)
        world.pose[0] = in_hole(misalignment[0], planar)
        world.stop_shear[0] = drawn if motion.stop_shear_mm is None else motion.stop_shear_mm / per_newton
        result = world.attempt(rng, which=np.arange(world.num_envs) == 0)
        if result.failed[0]:
            raise UsageError("this world cannot be simulated")
        if not result.inserted[0]:
            flow = _vectors(result.image[0], float(result.divisor[0]), world.task)
            rows.append((0, planar, float(result.depth[0]), flow, float(result.offset[0])))
    return rows


def _with_policy(
    world: InsertionAttempts, misalignment: Array, attempts: int, rng: np.random.Generator
) -> tuple[list[_Row], dict[int, Array]]:
    """Insertions with the included policy: the first `attempts` of each, and the planar poses of inserted parts."""
    task, insertions = world.task, world.num_envs
    shipped = load_network(default_checkpoint(), task=INSERTION)
    assert isinstance(shipped, FlowMapNetwork)
    policies = [NetworkPolicy(shipped) for _ in range(insertions)]
    planar, active = np.zeros((insertions, 3)), np.ones(insertions, dtype=bool)
    rows: list[_Row] = []
    inserted: dict[int, Array] = {}
    for attempt in range(task.attempts):
        if not active.any():
            break
        world.pose[:] = in_hole(misalignment, planar)
        result = world.attempt(rng, which=active)
        for k, i in enumerate(np.flatnonzero(active)):
            if result.failed[k]:
                raise UsageError("this world cannot be simulated")
            if result.inserted[k]:
                inserted[int(i)] = planar[i].copy()
                active[i] = False
                continue
            flow = _vectors(result.image[k], float(result.divisor[k]), task)
            if attempt < attempts:
                rows.append((int(i), planar[i].copy(), float(result.depth[k]), flow, float(result.offset[k])))
            observed = FlowMap(result.image[k], float(result.divisor[k]), "N", np.zeros((2, 1, 1), bool))
            planar[i] = task.corrected(planar[i], policies[i].act(observed))
    return rows, inserted


def _recordings(
    rows: Sequence[_Row],
    kept: Sequence[int],
    task: InsertionTask,
    inserted: Mapping[int, Array],
    fixed: Mapping[str, float],
    rng: np.random.Generator,
    *,
    planned: bool,
) -> Recordings:
    """Recordings of attempts; `kept` are the insertions."""
    new = {old: k for k, old in enumerate(kept)}
    return Recordings(
        task,
        np.array([new[row[0]] for row in rows], dtype=np.int64),
        np.stack([row[1] for row in rows]),
        np.array([row[2] for row in rows]),
        np.stack([row[3] for row in rows]),
        "N",
        tuple(f"insertion {row[0]}, pose {k}" for k, row in enumerate(rows)),
        {new[i]: pose for i, pose in inserted.items() if i in new},
        planned=np.full(len(rows), planned),
        grasp_force=fixed["grasp_force"] * float(np.exp(COMMANDED_FORCE * rng.normal())),
        grasp_height=fixed["grasp_height"] + TAUGHT_HEIGHT * float(rng.normal()),
    )


def _truth(values: Mapping[str, float], gain: Array, turn: Array, depth: float) -> dict[str, float]:
    ratio = values["gel_time"] * DESCENT_SPEED / depth
    lag = 1 - values["gel_creep"] * ratio * (1 - np.exp(-1 / ratio))  # the force rises linearly during a descent
    names = ("pad_kn", "pad_mu", "pad_ks", "marker_kn", "marker_mu", "marker_ks", "hole_kn", "hole_mu",
             "arm_stiffness", "grasp_force", "grasp_height", "crosstalk")  # fmt: skip
    pads = {f"gain_{side}": float(gain[k] * lag) for k, side in enumerate(("left", "right"))}
    turns = {f"turn_{side}": float(turn[k]) for k, side in enumerate(("left", "right"))}
    of_pads = {**pads, **turns, "gain_ratio": float(gain[1] / gain[0])}
    return {**{name: values[name] for name in names}, **of_pads}


def _vectors(image: NDArray[np.float32], divisor: float, task: InsertionTask) -> Array:
    """Marker vectors (pads, rows, cols, 2) of the last frame of a flow map."""
    grid = task.grid
    frames = image.reshape(-1, task.sensors, 2, grid.rows, grid.cols)
    return np.asarray(frames[-1].transpose(0, 2, 3, 1) * divisor, dtype=float)
