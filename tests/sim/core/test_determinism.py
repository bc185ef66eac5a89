"""All results of a simulator are bitwise independent of threads and batch, in every scene."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.sim.scene import Scene, load_scene, scene_names
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.reference_motions import reference_motion

Array = NDArray[np.float64]

ENVS = 8
STEPS = 3
OVERRIDES = {"rolling": {"pads.pad.rows": 12, "pads.pad.cols": 12, "points.pad.resolution": [8, 8, 3]}}
IN_TOUCH = {"rolling": 0.2, "pushing": 0.2, "insertion": 0.3, "grasp": 0.2, "dclaw": 0.3}  # time in contact [s]

Compute = Callable[[Simulator, Array], list[NDArray[Any]]]  # (batch, controls (steps, N, nu)) → arrays with N first


def stepped(sim: Simulator, u: Array) -> list[NDArray[Any]]:
    rows = []
    for now in u:
        sim.step(now)
        rows += [sim.q, sim.v, sim.anchors, sim.anchored, sim.history, sim.wrenches(), sim.poses()]
        rows = [row.copy() for row in rows]
    sim.check()
    return rows


def read(sim: Simulator, u: Array) -> list[NDArray[Any]]:
    first = sim.tactile().copy()
    sim.step(u[0])
    return [first, sim.tactile()]


def rolled(sim: Simulator, u: Array) -> list[NDArray[Any]]:
    run = sim.rollout(u, read_after=[1, len(u)])
    parts: tuple[NDArray[Any], ...] = (
        run.q,
        run.v,
        run.anchors,
        run.anchored,
        run.history,
        run.tactile,
        run.halvings,
        sim.contact_modes(run),
    )
    return [np.moveaxis(part, 1, 0) for part in parts]


def differentiated(sim: Simulator, u: Array) -> list[NDArray[Any]]:
    run = sim.rollout(u, read_after=[len(u)])
    weights = [np.random.default_rng(k).normal(size=x.shape[2:]) for k, x in enumerate((run.q, run.v, run.tactile))]
    by = dict(zip(("q", "v", "tactile"), weights, strict=True))
    found: list[Array] = []
    for params in (False, True):
        g = sim.rollout_gradient(run, **by, params=params)
        found += [np.moveaxis(g.u, 1, 0), g.q, g.v, g.anchors, g.history, g.params]
    return found


def estimated(sim: Simulator, u: Array) -> list[NDArray[Any]]:
    return [sim.error_estimate(u[0])]


COMPUTED: dict[str, Compute] = {
    "step": stepped,
    "tactile": read,
    "rollout": rolled,
    "rollout_gradient": differentiated,
    "error_estimate": estimated,
}


@pytest.fixture(
    scope="module", params=[(name, law) for name in scene_names() for law in ("viscous", "elastic")], ids=str
)
def case(request: pytest.FixtureRequest) -> tuple[Scene, Array, dict[str, Array]]:
    """A scene with BDF2, controls (STEPS, nu) in the middle of its motion, and the state there."""
    name, law = request.param
    scene = load_scene(name, friction=law, overrides={**OVERRIDES.get(name, {}), "integrator": "bdf2"})
    moves = reference_motion(scene)
    u, middle = moves.step_controls(scene.step), round(IN_TOUCH[name] / scene.step)
    sim = Simulator(scene)
    sim.q[0] = moves.q0
    for now in u[:middle]:
        sim.step(now)
    sim.check()
    assert sim.tactile().any()
    state = {part: getattr(sim, part)[0].copy() for part in ("q", "v", "anchors", "anchored", "history")}
    return scene, u[middle : middle + STEPS], state


def batch(case: tuple[Scene, Array, dict[str, Array]], envs: Sequence[int], threads: int) -> tuple[Simulator, Array]:
    """The given environments, with individual velocities, masses and controls."""
    scene, u, state = case
    sim = Simulator(scene, num_envs=len(envs), threads=threads)
    for part, value in state.items():
        getattr(sim, part)[:] = value
    for place, env in enumerate(envs):
        rng = np.random.default_rng(env)
        sim.v[place] *= 1 + 0.02 * rng.normal(size=sim.model.nv)
        sim.params[place] *= 1 + 1e-5 * env
    return sim, np.stack([u * (1 + 1e-5 * env) for env in envs], axis=1)


def bits(compute: Compute, sim: Simulator, u: Array) -> list[bytes]:
    """All results, by environment."""
    parts = compute(sim, u)
    return [b"".join(np.ascontiguousarray(part[env]).tobytes() for part in parts) for env in range(sim.num_envs)]


@pytest.mark.parametrize("what", COMPUTED)
def test_results_are_bitwise_independent_of_threads_and_batch(
    case: tuple[Scene, Array, dict[str, Array]], what: str
) -> None:
    everyone = list(range(ENVS))
    reference = bits(COMPUTED[what], *batch(case, everyone, 1))
    assert len(set(reference)) == ENVS  # the environments differ
    for threads in (2, 7):
        assert bits(COMPUTED[what], *batch(case, everyone, threads)) == reference
    others = [6, 1, 1, 4, 0]  # other order and size, one environment twice
    assert bits(COMPUTED[what], *batch(case, others, 2)) == [reference[env] for env in others]
    for env in (0, 5):
        assert bits(COMPUTED[what], *batch(case, [env], 7)) == [reference[env]]
