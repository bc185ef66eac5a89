"""Islands: groups of coupled bodies are solved apart, with the results of one dense system.

The dense system is forced by loop closures between all bodies whose forces are zero to all digits.
"""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.sim import _core
from gelflow.sim.scene import FRICTION_LAWS, INTEGRATORS
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation import gradient_check
from gelflow.sim.validation.contact_states import POLISH

Array = NDArray[np.float64]

HALF = 0.01  # [m] half of a cube's edge
CORNERS = HALF * np.array([[x, 0.8 * y, 0.8 * z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
FACES = HALF * np.array([s * row for row in np.eye(3) for s in (-1, 1)])
LAW: dict[str, Any] = {"kn": 100.0, "kt": 1.0, "mu": 0.4, "kd": 5.0}
NO_FORCE = 1e-200  # stiffness


def cubes(
    count: int,
    *,
    law: str = "viscous",
    integrator: str = "bdf1",
    dense: bool = False,
    collide: bool = True,
    points: Array = CORNERS,
) -> _core.ModelSpec:
    """Free cubes in a row over a plane; each may touch the next but one: islands have dofs that are not consecutive."""
    spec = _core.ModelSpec()
    spec.integrator, spec.polish, spec.tolerance = integrator, POLISH, 1e-10
    ground = spec.add_shape(_core.ShapeDef(name="ground", kind="plane"))
    numbers: dict[str, Any] = {"law": law, **LAW, "ks": 50.0 if law == "elastic" else 0.0}
    bodies, clouds, faces = [], [], []
    for i in range(count):
        body = spec.add_body(
            _core.BodyDef(
                name=f"cube{i}",
                pos=(2.5 * HALF * i, 0, HALF),
                mass=0.01 * (1 + i % 3),
                com=(1e-3, 0, 2e-3 * (i % 2)),
                inertia=(7e-7, 8e-7, 9e-7, 0, 0, 0),
            )
        )
        spec.add_joint(_core.JointDef(name=f"free{i}", body=body, type="free"))
        clouds.append(spec.add_points(_core.PointsDef(name=f"cloud{i}", body=body, points=points)))
        faces.append(spec.add_shape(_core.ShapeDef(name=f"box{i}", kind="box", body=body, size=(HALF,) * 3)))
        spec.add_contact(_core.ContactDef(name=f"ground{i}", points=clouds[i], shape=ground, **numbers))
        bodies.append(body)
    for i in range(count - 2 if collide else 0):
        spec.add_contact(_core.ContactDef(name=f"pair{i}", points=clouds[i], shape=faces[i + 2], **numbers))
    for i in range(count - 1 if dense else 0):
        spec.add_loop_closure(
            _core.LoopClosureDef(name=f"join{i}", first=bodies[i], second=bodies[i + 1], stiffness=NO_FORCE, damping=0)
        )
    return spec


def collision(spec: _core.ModelSpec, envs: int = 1, **options: Any) -> Simulator:
    """Cubes that fly at the cubes after the next ones, hit them, and part: pairs are 5 half edges apart."""
    sim = Simulator(_core.Model(spec), num_envs=envs, **options)
    rng = np.random.default_rng(5)
    count = sim.model.nq // 7
    q, v = sim.q.reshape(envs, count, 7), sim.v.reshape(envs, count, 6)
    q[:, :, 1] = 6 * HALF * (np.arange(count) % 2)  # two rows
    q[:, :, 2] = HALF * (1 + 1e-3 * rng.normal(size=(envs, count)))
    v[:] = 0.05 * rng.normal(size=v.shape)
    v[:, :, 0] += 1.5 * (np.arange(count) % 4 < 2)  # of a pair, the first one
    return sim


def rest(sim: Simulator) -> Array:
    return np.zeros(sim.model.nu)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("law", FRICTION_LAWS)
def test_islands_that_merge_and_split_give_the_results_of_one_dense_system(law: str, integrator: str) -> None:
    sims = [collision(cubes(6, law=law, integrator=integrator, dense=dense)) for dense in (False, True)]
    pairs = slice(6, 10)
    touched = []
    for _ in range(24):
        for sim in sims:
            sim.step(rest(sim))
            sim.check()
        touched.append(np.abs(sims[0].wrenches()[0, pairs]).sum(axis=1) > 0)
        np.testing.assert_allclose(sims[0].q, sims[1].q, rtol=0, atol=1e-9)
        np.testing.assert_allclose(sims[0].v, sims[1].v, rtol=0, atol=1e-6)
    merged = np.any(touched, axis=1)
    assert merged.any()
    assert not merged[0]
    assert not merged[-1]


@pytest.mark.parametrize("count", [3, 40])
def test_independent_bodies_move_like_single_ones(count: int) -> None:
    together = Simulator(_core.Model(cubes(count, collide=False)))
    alone = Simulator(_core.Model(cubes(1, collide=False)), num_envs=count)
    for name in alone.model.param_names:
        for i in range(count):
            other = name.replace("cube0", f"cube{i}").replace("free0", f"free{i}").replace("cloud0", f"cloud{i}")
            other = other.replace("box0", f"box{i}").replace("ground0", f"ground{i}")
            alone.param(name)[i] = together.param(other)[0]
    rng = np.random.default_rng(2)
    velocity = 0.1 * rng.normal(size=(count, 6))
    alone.q[:] = together.q.reshape(count, 7)
    alone.v[:] = velocity
    together.v[:] = velocity.reshape(1, -1)
    for _ in range(20):
        together.step(rest(together))
        alone.step(rest(alone))
    np.testing.assert_allclose(together.q.reshape(count, 7), alone.q, rtol=0, atol=1e-10)
    np.testing.assert_allclose(together.v.reshape(count, 6), alone.v, rtol=0, atol=1e-8)
    mass = together.mass_matrix()[0].reshape(count, 6, count, 6)
    for i in range(count):
        np.testing.assert_allclose(mass[i, :, i], alone.mass_matrix()[i], atol=1e-16)
        mass[i, :, i] = 0
    assert not mass.any()


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("law", FRICTION_LAWS)
def test_gradients_through_islands_that_merge_and_split(law: str, integrator: str) -> None:
    """The collision of the test above: 16 steps before, in and after contact. The adjoint identity, by dual numbers."""
    outputs: tuple[gradient_check.Output, ...] = ("q", "v")
    for seed, output in enumerate(outputs):
        rng = np.random.default_rng(seed)
        sim = collision(cubes(4, law=law, integrator=integrator))
        case = gradient_check.RolloutLoss.random(sim, np.zeros((16, 0)), output, rng)
        agreement = gradient_check.compare_to_dual_numbers(case, rng, directions=2)
        assert agreement.error < 1e-8, agreement


def test_gradients_agree_with_differences() -> None:
    rng = np.random.default_rng(4)
    sim = collision(cubes(3, points=np.concatenate([CORNERS, FACES])))
    case = gradient_check.RolloutLoss.random(sim, np.zeros((8, 0)), "v", rng)
    agreement = gradient_check.compare_to_differences(case)
    assert agreement.error < 1e-5, agreement


@pytest.mark.parametrize("precision", ["double", "single"])
def test_results_do_not_depend_on_threads_or_on_other_environments(precision: Literal["double", "single"]) -> None:
    """Threads change between environments whose islands differ."""
    envs = 5
    many = collision(cubes(6, law="elastic"), envs, threads=3, precision=precision)
    one = collision(cubes(6, law="elastic"), envs, threads=1, precision=precision)
    single = Simulator(_core.Model(cubes(6, law="elastic")), threads=1, precision=precision)
    start = one.q.copy(), one.v.copy()
    for _ in range(16):
        many.step(rest(many))
        one.step(rest(one))
    np.testing.assert_array_equal(many.q, one.q)
    np.testing.assert_array_equal(many.v, one.v)
    single.q[:], single.v[:] = start[0][3], start[1][3]
    for _ in range(16):
        single.step(rest(single))
    np.testing.assert_array_equal(single.q[0], one.q[3])


def slides(dense: bool) -> _core.ModelSpec:
    """Twenty masses on slides with springs; a coupling, a polynomial and a tendon connect some that are far apart."""
    spec = _core.ModelSpec()
    spec.tolerance, spec.polish = 1e-12, POLISH
    joints = []
    for i in range(20):
        body = spec.add_body(_core.BodyDef(name=f"mass{i}", mass=0.1 + 0.01 * i, inertia=(1e-5,) * 3 + (0, 0, 0)))
        joints.append(
            spec.add_joint(
                _core.JointDef(
                    name=f"x{i}", body=body, type="slide", axis=(1, 0, 0), stiffness=5.0 + i, damping=0.1, springref=0.1
                )
            )
        )
    for i in range(19 if dense else 0):
        spec.add_loop_closure(
            _core.LoopClosureDef(name=f"join{i}", first=i, second=i + 1, stiffness=NO_FORCE, damping=0)
        )
    spec.add_coupling(_core.CouplingDef(name="pair", joint=joints[1], leader=joints[18], coefficients=(0.01, 2.0)))
    spec.add_coupling(
        _core.CouplingDef(
            name="cam", joint=joints[3], leader=joints[15], coefficients=(0, 0.5, 3.0), stiffness=200.0, damping=1.0
        )
    )
    tendon = spec.add_tendon(
        _core.TendonDef(
            name="belt", joints=[joints[2], joints[9], joints[18]], coefficients=[1.0, -2.0, 0.5], stiffness=30.0,
            damping=0.2, armature=0.05,
        )
    )  # fmt: skip
    spec.add_actuator(_core.ActuatorDef(name="pull", tendon=tendon, kind="motor"))
    return spec


def test_couplings_and_tendons_join_islands() -> None:
    sims = [Simulator(_core.Model(slides(dense))) for dense in (False, True)]
    for sim in sims:
        sim.step(np.array([0.3]), 40)
    np.testing.assert_allclose(sims[0].q, sims[1].q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(sims[0].mass_matrix(), sims[1].mass_matrix(), atol=1e-16)
    assert sims[0].mass_matrix()[0, 2, 9] != 0
    rng = np.random.default_rng(1)
    case = gradient_check.RolloutLoss.random(sims[0], rng.normal(size=(6, 1)), "v", rng)
    assert gradient_check.compare_to_dual_numbers(case, rng, directions=2).error < 1e-10


def test_a_body_that_is_moved_from_outside_pushes_others() -> None:
    """Its velocity has a gradient through the contact that joins it to an island."""
    results = []
    for dense in (False, True):
        spec = cubes(5, dense=dense)
        pusher = spec.add_body(
            _core.BodyDef(name="pusher", pos=(-2.3 * HALF, 0, HALF), mass=1, inertia=(1e-4,) * 3 + (0,) * 3)
        )
        spec.add_joint(_core.JointDef(name="pusher", body=pusher, type="free", prescribed=True))
        cloud = spec.add_points(_core.PointsDef(name="pusher", body=pusher, points=CORNERS * 0.9))
        spec.add_contact(_core.ContactDef(name="push", points=cloud, shape=1, **LAW))
        sim = Simulator(_core.Model(spec))
        sim.v[0, -6] = 0.2
        rng = np.random.default_rng(3)
        case = gradient_check.RolloutLoss.random(sim, np.zeros((10, 0)), "v", rng)
        assert gradient_check.compare_to_dual_numbers(case, rng, directions=1, groups=False).error < 1e-8
        results.append(gradient_check.reverse_gradient(case)[1]["v"])
        assert np.abs(results[-1][-6]) > 0
    np.testing.assert_allclose(results[0], results[1], rtol=1e-6, atol=1e-9)


def test_trees_whose_dofs_alternate() -> None:
    """Bodies of two arms, added in turn, and a row of masses behind them."""
    sims = []
    for turns in (True, False):
        spec = _core.ModelSpec()
        spec.tolerance, spec.polish = 1e-12, POLISH
        order = [(k % 2, k // 2) for k in range(12)] if turns else [(arm, k) for arm in range(2) for k in range(6)]
        index: dict[tuple[int, int], int] = {}
        for arm, k in order:
            index[arm, k] = spec.add_body(
                _core.BodyDef(
                    name=f"link{arm}.{k}", parent=index.get((arm, k - 1), -1), pos=(0, 1.0 * arm * (k == 0), -0.1),
                    mass=0.1, inertia=(1e-4, 1e-4, 2e-5, 0, 0, 0),
                )
            )  # fmt: skip
            spec.add_joint(
                _core.JointDef(
                    name=f"hinge{arm}.{k}",
                    body=index[arm, k],
                    type="hinge",
                    pos=(0, 0, 0.1),
                    axis=(0.3, 1, 0),
                    damping=1e-3,
                )
            )
        for i in range(8):
            body = spec.add_body(_core.BodyDef(name=f"mass{i}", mass=0.1, inertia=(1e-5,) * 3 + (0, 0, 0)))
            spec.add_joint(_core.JointDef(name=f"x{i}", body=body, type="slide", stiffness=5.0 + i))
        sim = Simulator(_core.Model(spec))
        for i in range(2):
            sim.q[0, sim.joint_q(f"hinge{i}.0")] = 0.5 + 0.3 * i
        sim.step(rest(sim), 50)
        sims.append(sim)
    for name in sims[0].model.joint_names:
        np.testing.assert_allclose(
            sims[0].q[0, sims[0].joint_q(name)], sims[1].q[0, sims[1].joint_q(name)], rtol=0, atol=1e-12
        )


def test_memory_grows_with_the_islands_and_not_with_their_square() -> None:
    """A dense system of 1000 free bodies has four matrices of 288 MB per thread."""
    program = """
import resource
import numpy as np
from test_islands import cubes
from gelflow.sim import _core
from gelflow.sim.simulator import Simulator
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
sim = Simulator(_core.Model(cubes(1000)), threads=1)
sim.step(np.zeros(0), 2)
trajectory = sim.rollout(np.zeros((2, 1, 0)))
sim.rollout_gradient(trajectory, v=np.ones_like(trajectory.v), params=True)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""
    here = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=here)
    assert int(result.stdout) < 400_000  # [kB]
