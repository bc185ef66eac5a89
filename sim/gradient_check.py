"""The one gradient checker: analytic gradients of a rollout against dual numbers and against central differences.

The scalar is a random linear function of one part of the end of a rollout (positions, velocities or marker readings);
its gradient with respect to controls, initial positions and initial velocities comes from the reverse pass.

* Dual numbers run the same core with the same branches and give the exact derivative along one direction: agreement
  to rounding shows that every analytic derivative and the reverse pass are right.
* Central differences know nothing of the derivation. A stencil whose runs took other branches than the middle
  (touching, sliding, clipped) measures a kink, not a derivative: it is left out and counted.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import SimulationError
from gelflow.sim import _core
from gelflow.sim.simulator import Simulator, Trajectory

Output = Literal["q", "v", "tactile"]


@dataclass(frozen=True)
class Agreement:
    """How well two ways to a gradient agree."""

    error: float  # norm of the difference over norm of the gradient
    left_out: float  # share of stencils left out for crossing a branch (0 for dual numbers)


def turning_joints(model: Any) -> list[tuple[int, int]]:
    """(first number of the quaternion, first angular velocity) of each ball and free joint."""
    ends = [*list(model.joint_q)[1:], model.nq]
    widths = [end - q for q, end in zip(model.joint_q, ends, strict=True)]
    return [
        (q + width - 4, v + width - 4)  # a free joint has three plain positions before
        for q, v, width in zip(model.joint_q, model.joint_v, widths, strict=True)
        if width >= 4
    ]


def _straight(model: Any) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which positions and which velocities are plain numbers: all but the quaternions and their angular velocities."""
    straight_q, straight_v = np.ones(model.nq, bool), np.ones(model.nv, bool)
    for at_q, at_v in turning_joints(model):
        straight_q[at_q : at_q + 4] = False
        straight_v[at_v : at_v + 3] = False
    return straight_q, straight_v


def _columns(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 3): quaternion ⊗ (0, δ) as a linear map of δ; its columns are orthonormal."""
    w, x, y, z = quaternion
    return np.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]])


def _turn(quaternion: NDArray[np.float64], by: NDArray[np.float64]) -> NDArray[np.float64]:
    """quaternion ⊗ exp(by), both along the last axis."""
    angle = np.linalg.norm(by, axis=-1, keepdims=True)
    scale = np.where(angle > 1e-12, np.sin(angle / 2) / np.maximum(angle, 1e-12), 0.5)
    w, x = np.cos(angle / 2), by * scale
    a, b = quaternion[..., :1], quaternion[..., 1:]
    scalar = a * w - (b * x).sum(-1, keepdims=True)
    return np.concatenate([scalar, a * x + w * b + np.cross(b, x)], axis=-1)


def retract(model: Any, q: NDArray[np.float64], tangent: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions q (…, nq) displaced by tangent vectors (…, nv)."""
    q, tangent = np.broadcast_to(q, (*tangent.shape[:-1], model.nq)).copy(), np.asarray(tangent)
    straight_q, straight_v = _straight(model)
    for at_q, at_v in turning_joints(model):
        q[..., at_q : at_q + 4] = _turn(q[..., at_q : at_q + 4], tangent[..., at_v : at_v + 3])
    q[..., straight_q] += tangent[..., straight_v]
    return q


def to_tangent(model: Any, q: NDArray[np.float64], gradient: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gradient with respect to q (nq,) as a gradient with respect to its tangent (nv,)."""
    straight_q, straight_v = _straight(model)
    result = np.zeros(model.nv)
    for at_q, at_v in turning_joints(model):
        result[at_v : at_v + 3] = 0.5 * _columns(q[at_q : at_q + 4]).T @ gradient[at_q : at_q + 4]
    result[straight_v] = gradient[straight_q]
    return result


@dataclass(frozen=True)
class Case:
    """A rollout of one environment from its simulator's state, and a random scalar of its end."""

    sim: Simulator  # one environment, double precision
    u: NDArray[np.float64]  # (steps, nu)
    output: Output
    weights: NDArray[np.float64]  # of the scalar: (nv,) on the tangent of q, (nv,), or (markers, 3)

    @classmethod
    def random(cls, sim: Simulator, u: NDArray[np.float64], output: Output, rng: np.random.Generator) -> "Case":
        shape = (sim.model.markers, 3) if output == "tactile" else (sim.model.nv,)
        return cls(sim, u, output, rng.normal(size=shape))

    @property
    def reads(self) -> tuple[int, ...]:
        return (len(self.u),) if self.output == "tactile" else ()


def analytic(case: Case, *, params: bool = False) -> tuple[Trajectory, dict[str, NDArray[np.float64]]]:
    """The rollout, and the gradient by the reverse pass: "u" (steps, nu), "q" (nv,) as a tangent, "v" (nv,),
    "anchors" (na, 3), "history" (nh,), and with `params` "params" (parameters,)."""
    sim, model = case.sim, case.sim.model
    trajectory = sim.rollout(case.u[:, None], read_after=case.reads)
    if trajectory.status[0]:
        raise SimulationError("the rollout to be checked failed")
    by: dict[str, NDArray[np.float64]] = {}
    if case.output == "q":
        by["q"] = np.zeros_like(trajectory.q)
        by["q"][-1, 0] = _from_tangent(model, trajectory.q[-1, 0], case.weights)
    elif case.output == "v":
        by["v"] = np.zeros_like(trajectory.v)
        by["v"][-1, 0] = case.weights
    else:
        by["tactile"] = case.weights[None, None]
    g = sim.rollout_gradient(trajectory, params=params, **by)
    start = to_tangent(model, trajectory.q[0, 0], g.q[0])
    gradient = {"u": g.u[:, 0], "q": start, "v": g.v[0], "anchors": g.anchors[0], "history": g.history[0]}
    return trajectory, {**gradient, "params": g.params[0]} if params else gradient


def _from_tangent(model: Any, q: NDArray[np.float64], tangent: NDArray[np.float64]) -> NDArray[np.float64]:
    straight_q, straight_v = _straight(model)
    result = np.zeros(model.nq)
    for at_q, at_v in turning_joints(model):
        result[at_q : at_q + 4] = 2 * _columns(q[at_q : at_q + 4]) @ tangent[at_v : at_v + 3]
    result[straight_q] = tangent[straight_v]
    return result


def against_dual(case: Case, rng: np.random.Generator, *, directions: int = 3) -> Agreement:
    """Worst relative difference along random directions in u, q, v, anchors, history, params: each alone, and all.

    The adjoint identity ⟨w, J d⟩ = ⟨Jᵀ w, d⟩ is what is compared: J d by dual numbers, Jᵀ w by the reverse pass.
    """
    sim, model = case.sim, case.sim.model
    trajectory, gradient = analytic(case, params=True)
    set_now = sim.anchored[0].astype(bool)
    parts = ["u", "q", "v", "params"]
    parts += ["anchors"] * bool(set_now.any()) + ["history"] * bool(sim.history[0].any())
    scale = _param_scale(sim.params[0])
    worst = 0.0
    for _ in range(directions):
        for only in [*parts, "all"]:
            d = {name: np.zeros_like(value) for name, value in gradient.items()}
            for name in parts if only == "all" else [only]:
                d[name] = rng.normal(size=d[name].shape)
            d["anchors"][~set_now] = 0
            d["params"] *= scale
            d["history"][-1:] = 0  # whether there is one
            exact = _core.directional_rollout(
                model, sim.params[0], sim.q[0], sim.v[0], sim.anchors[0], sim.anchored[0], sim.history[0], case.u,
                d["params"], d["q"], d["v"], d["anchors"], d["history"], d["u"],
            )  # fmt: skip
            along = case.weights.ravel() @ exact["d" + case.output]
            size = np.linalg.norm(case.weights) * np.linalg.norm(exact["d" + case.output])
            ours = sum(float((gradient[name] * d[name]).sum()) for name in gradient)
            worst = max(worst, abs(along - ours) / max(size, 1e-300))
            if np.abs(exact["q"] - trajectory.q[-1, 0]).max() > 1e-9:
                raise SimulationError("the dual-number run left the run that it should repeat")
    return Agreement(worst, 0.0)


def _param_scale(params: NDArray[np.float64]) -> NDArray[np.float64]:
    """By how much each parameter is displaced: by its own size; infinite limits and zeros hardly."""
    return np.where(np.isfinite(params), np.maximum(np.abs(params), 1e-6), 0.0)


FACTORS = (4.0, 2.0, 1.0, 0.5, 0.25)  # stencil sizes that are tried, times `STENCIL`
STENCIL = {"u": 1e-5, "q": 1e-7, "v": 1e-5}
OFFSETS = np.array([-2.0, -1.0, 1.0, 2.0])
COEFFICIENTS = np.array([1.0, -8.0, 8.0, -1.0]) / 12


def against_differences(case: Case) -> Agreement:
    """Gradient with respect to (u, q, v) by five-point central differences, entry by entry.

    Each entry is differenced with several stencil sizes; of those that stayed on the middle's branch the one counts
    that differs least from its smaller neighbour, which is where rounding and truncation balance. The analytic
    gradient has no say in that choice. An entry with fewer than two such stencils is left out. The error is the largest
    over u, q and v of norm of the difference over norm, as their units differ.
    """
    model = case.sim.model
    middle, gradient = analytic(case)
    ours = np.concatenate([gradient["u"].ravel(), gradient["q"], gradient["v"]])
    kind = np.repeat(["u", "q", "v"], [case.u.size, model.nv, model.nv])
    sizes = np.array([STENCIL[k] for k in kind])[:, None] * np.array(FACTORS)  # (entries, factors)
    ends, same = _displaced(case, middle, kind, sizes)
    estimates = (ends @ COEFFICIENTS) / sizes
    differences = np.abs(np.diff(estimates, axis=1))
    differences[~(same[:, :-1] & same[:, 1:])] = np.inf
    keep = np.isfinite(differences).any(1)
    numeric = np.take_along_axis(estimates[:, :-1], differences.argmin(1)[:, None], 1)[:, 0]
    errors = [
        np.linalg.norm((numeric - ours)[keep & (kind == k)]) / (float(np.linalg.norm(ours[kind == k])) + 1e-300)
        for k in ("u", "q", "v")
    ]
    return Agreement(float(max(errors)), float(1 - keep.mean()))


def _displaced(
    case: Case, middle: Trajectory, kind: NDArray[np.str_], sizes: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The scalar less its middle value (entries, factors, 4); whether a stencil kept its branch (entries, factors).

    Every point of every stencil is an environment of one batch.
    """
    sim, model = case.sim, case.sim.model
    shape = (*sizes.shape, len(OFFSETS))
    amounts = (sizes[..., None] * OFFSETS).ravel()
    entry = np.broadcast_to(np.arange(len(sizes))[:, None, None], shape).ravel()
    n = len(amounts)
    moves = {k: np.zeros((n, int((kind == k).sum()))) for k in ("u", "q", "v")}
    for k, move in moves.items():
        chosen = kind[entry] == k
        move[chosen, entry[chosen] - np.flatnonzero(kind == k)[0]] = amounts[chosen]
    many = Simulator(model, num_envs=n)
    many.params[:] = sim.params[0]
    run = many.rollout(
        case.u[:, None] + moves["u"].reshape(n, *case.u.shape).transpose(1, 0, 2),
        q=retract(model, sim.q[0], moves["q"]),
        v=sim.v + moves["v"],
        anchors=np.repeat(sim.anchors, n, axis=0),
        anchored=np.repeat(sim.anchored, n, axis=0),
        history=np.repeat(sim.history, n, axis=0),
        read_after=case.reads,
    )
    if case.output == "q":
        ends = np.array([_difference(model, q, middle.q[-1, 0]) for q in run.q[-1]]) @ case.weights
    elif case.output == "v":
        ends = (run.v[-1] - middle.v[-1]) @ case.weights
    else:
        ends = ((run.tactile[0] - middle.tactile[0]) * case.weights).sum((1, 2))
    same = (many.branches(run) == sim.branches(middle)).all(0) & (run.status == 0)
    return ends.reshape(shape), same.reshape(shape).all(-1)


def _difference(model: Any, q: NDArray[np.float64], base: NDArray[np.float64]) -> NDArray[np.float64]:
    """Tangent from `base` to a nearby q."""
    straight_q, straight_v = _straight(model)
    result = np.zeros(model.nv)
    for at_q, at_v in turning_joints(model):
        vector = _columns(base[at_q : at_q + 4]).T @ q[at_q : at_q + 4]  # sin(angle/2) axis
        length = float(np.linalg.norm(vector))
        result[at_v : at_v + 3] = 2 * vector * (np.arcsin(min(length, 1.0)) / length if length > 1e-12 else 1.0)
    result[straight_v] = (q - base)[straight_q]
    return result
