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
    skipped: float  # share of entries left out, as every stencil crossed a branch (0 for dual numbers)
    worst: str = ""  # where the error is: "u", "q", "v", or a group of parameters
    entries: int = 0  # that were to be compared


def quaternion_joints(model: Any) -> list[tuple[int, int]]:
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
    for at_q, at_v in quaternion_joints(model):
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
    for at_q, at_v in quaternion_joints(model):
        q[..., at_q : at_q + 4] = _turn(q[..., at_q : at_q + 4], tangent[..., at_v : at_v + 3])
    q[..., straight_q] += tangent[..., straight_v]
    return q


def to_tangent(model: Any, q: NDArray[np.float64], gradient: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gradient with respect to q (nq,) as a gradient with respect to its tangent (nv,)."""
    straight_q, straight_v = _straight(model)
    result = np.zeros(model.nv)
    for at_q, at_v in quaternion_joints(model):
        result[at_v : at_v + 3] = 0.5 * _columns(q[at_q : at_q + 4]).T @ gradient[at_q : at_q + 4]
    result[straight_v] = gradient[straight_q]
    return result


@dataclass(frozen=True)
class RolloutLoss:
    """A rollout of one environment from its simulator's state, and a random scalar of its end."""

    sim: Simulator  # one environment, double precision
    u: NDArray[np.float64]  # (steps, nu)
    output: Output
    weights: NDArray[np.float64]  # of the scalar: (nv,) on the tangent of q, (nv,), or (markers, 3)

    @classmethod
    def random(cls, sim: Simulator, u: NDArray[np.float64], output: Output, rng: np.random.Generator) -> "RolloutLoss":
        shape = (sim.model.markers, 3) if output == "tactile" else (sim.model.nv,)
        return cls(sim, u, output, rng.normal(size=shape))

    @property
    def reads(self) -> tuple[int, ...]:
        return (len(self.u),) if self.output == "tactile" else ()


def reverse_gradient(case: RolloutLoss, *, params: bool = False) -> tuple[Trajectory, dict[str, NDArray[np.float64]]]:
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
    for at_q, at_v in quaternion_joints(model):
        result[at_q : at_q + 4] = 2 * _columns(q[at_q : at_q + 4]) @ tangent[at_v : at_v + 3]
    result[straight_q] = tangent[straight_v]
    return result


def compare_to_dual_numbers(
    case: RolloutLoss, rng: np.random.Generator, *, directions: int = 3, groups: bool = True
) -> Agreement:
    """Worst relative difference along random directions in u, q, v, anchors, history, params: each alone, and all;
    with `groups` also in each group of parameters (`parameter_groups`) alone, once.

    The adjoint identity ⟨w, J d⟩ = ⟨Jᵀ w, d⟩ is what is compared: J d by dual numbers, Jᵀ w by the reverse pass.
    """
    sim, model = case.sim, case.sim.model
    trajectory, gradient = reverse_gradient(case, params=True)
    set_now = sim.anchored[0].astype(bool)
    parts = ["u", "q", "v", "params"]
    parts += ["anchors"] * bool(set_now.any()) + ["history"] * bool(sim.history[0].any())
    scale, group = parameter_scales(model, sim.params[0]), parameter_groups(model)
    found: list[tuple[str, float, float]] = []  # of what, difference, size
    tries = [(only, group == only) for only in np.unique(group)] if groups else []
    tries += [(only, np.ones(len(scale), bool)) for only in [*parts, "all"]] * directions
    for only, chosen in tries:
        d = {name: np.zeros_like(value) for name, value in gradient.items()}
        for name in parts if only == "all" else [only if only in parts else "params"]:
            d[name] = rng.normal(size=d[name].shape)
        d["anchors"][~set_now] = 0
        d["params"] *= scale * chosen
        d["history"][-1:] = 0  # whether there is one
        exact = _core.directional_rollout(
            model, sim.params[0], sim.q[0], sim.v[0], sim.anchors[0], sim.anchored[0], sim.history[0], case.u,
            d["params"], d["q"], d["v"], d["anchors"], d["history"], d["u"],
        )  # fmt: skip
        along = case.weights.ravel() @ exact["d" + case.output]
        size = np.linalg.norm(case.weights) * np.linalg.norm(exact["d" + case.output])
        ours = sum(float((gradient[name] * d[name]).sum()) for name in gradient)
        found.append((str(only), abs(float(along) - ours), float(size)))
        if np.abs(exact["q"] - trajectory.q[-1, 0]).max() > 1e-9:
            raise SimulationError("the dual-number run left the run that it should repeat")
    floor = 1e-6 * max(size for *_, size in found) + 1e-300  # below it rounding errors show
    error, most = max((difference / max(size, floor), only) for only, difference, size in found)
    return Agreement(float(error), 0.0, most)


def parameter_groups(model: Any) -> NDArray[np.str_]:
    """What each parameter is, whatever its owner: "kn", "pos", "inertia", "gravity", …; (parameters,)."""
    return np.array(
        [next(part for part in reversed(name.split(".")) if part not in _COMPONENTS) for name in model.param_names]
    )


_COMPONENTS = ("x", "y", "z", "xx", "yy", "zz", "xy", "xz", "yz")


def parameter_scales(model: Any, params: NDArray[np.float64]) -> NDArray[np.float64]:
    """By how much each parameter is displaced: by its own size, or one that fits what it is. 0 where it may not be:
    an infinite bound, a size that a shape does not have."""
    groups = parameter_groups(model)
    scale = np.where(np.isfinite(params), np.abs(params), 0.0)
    zero = params == 0
    inertia = np.flatnonzero(groups == "inertia").reshape(-1, 6)
    scale[inertia] = scale[inertia[:, :3]].mean(1, keepdims=True)
    light = scale[np.isin(groups, ("mass", "inertia"))]
    typical = {"pos": 0.01, "com": 0.01, "size": 0.0, "armature": float(np.median(light[light > 0]))}
    for group in set(groups[zero]) - {"inertia"}:
        scale[zero & (groups == group)] = typical.get(group, 1.0)
    return scale


# The sizes of stencils, largest first: a quarter of it is the next smaller. An entry starts with the first three; where
# they cross a branch, or do not agree, three smaller ones follow, and so on.
STENCIL = {"u": 1e-3, "q": 5e-6, "v": 1e-3, "params": 1e-3}  # the first: [as u], [m or rad], [m/s or rad/s], relative
RATIO, ROUNDS, PER_ROUND = 4, 5, 3
AGREE = 1e-8  # of two estimates, relative to the gradient: good enough
CHUNK = 128  # environments at a time


def compare_to_differences(case: RolloutLoss, *, params: bool = True) -> Agreement:
    """Gradient with respect to (u, q, v, params) by five-point central differences, entry by entry.

    A five-point difference is made of two of three points, of sizes s and s/4. Each entry is differenced with several
    sizes; of those that stayed on the middle's branch the one counts that differs least from its smaller neighbour,
    which is where rounding and truncation balance. All smaller ones tell how large rounding errors are (they grow
    fourfold from one to the next), since two estimates may be alike by chance. Smaller sizes are tried only where the
    larger ones crossed a branch or did not agree. The analytic gradient has no say in any of that. An entry without two
    such stencils is left out.

    The error is the largest over u, q, v and the groups of parameters, as their units differ, of norm of the difference
    over norm. Parameters count in multiples of `parameter_scales`; a group whose gradient is below a thousandth of that
    by all parameters counts as if it were one.
    """
    model = case.sim.model
    middle, gradient = reverse_gradient(case, params=params)
    kinds = ["u", "q", "v"] + ["params"] * params
    scale = {k: np.ones(gradient[k].size) for k in kinds}
    if params:
        scale["params"] = parameter_scales(model, case.sim.params[0])
        scale["params"][(parameter_groups(model) == "frictionloss") & (case.sim.params[0] == 0)] = 0  # never negative
    which = np.concatenate([np.flatnonzero(scale[k]) for k in kinds])
    kind = np.concatenate([np.full(int((scale[k] != 0).sum()), k) for k in kinds])
    unit = np.concatenate([scale[k][scale[k] != 0] for k in kinds])
    ours = np.concatenate([gradient[k].ravel()[scale[k] != 0] for k in kinds]) * unit
    label = (
        kind.copy()
        if not params
        else np.where(kind == "params", parameter_groups(model)[which * (kind == "params")], kind)
    )
    first = np.array([STENCIL[k] for k in kind])

    def norms(values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Per entry: of the part or group that it belongs to, those of small groups raised."""
        floor = 1e-3 * np.linalg.norm(values[kind == "params"])
        sums = {group: np.linalg.norm(values[label == group]) for group in np.unique(label)}
        return np.array(
            [max(float(sums[g]), floor if k == "params" else 0.0) for g, k in zip(label, kind, strict=True)]
        )

    slopes = np.full((len(kind), 1 + ROUNDS * PER_ROUND), np.nan)  # three-point; nan: crossed a branch, or not tried
    best, spread = np.full(len(kind), np.nan), np.full(len(kind), np.inf)
    for done in range(ROUNDS):
        todo = np.flatnonzero(~(spread <= AGREE * norms(np.nan_to_num(best))))
        columns = slice(done * PER_ROUND, (done + 1) * PER_ROUND)
        sizes = first[todo, None] / float(RATIO) ** np.arange(columns.start, columns.stop)
        slopes[todo, columns] = _slopes(case, middle, kind[todo], which[todo], unit[todo], sizes)
        estimates = (RATIO**2 * slopes[todo, 1:] - slopes[todo, :-1]) / (RATIO**2 - 1)
        differences = np.abs(np.diff(estimates, axis=1))
        doubt = differences.copy()
        # A difference that grew from one size to the next is rounding, and no smaller size has less of it.
        grown = np.where(differences[:, 1:] > differences[:, :-1], differences[:, 1:], 0.0)
        doubt[:, 1:] = np.fmax(doubt[:, 1:], np.maximum.accumulate(grown, axis=1))
        for column in range(doubt.shape[1] - 2, -1, -1):
            doubt[:, column] = np.fmax(doubt[:, column], doubt[:, column + 1] / RATIO)
        doubt[np.isnan(differences)] = np.inf
        chosen = np.arange(len(todo)), doubt.argmin(1)
        spread[todo], best[todo] = doubt[chosen], estimates[chosen]
    keep = np.isfinite(spread)
    allowed = norms(ours)
    errors = {
        str(group): np.linalg.norm((best - ours)[keep & (label == group)]) / max(allowed[label == group][0], 1e-300)
        for group in np.unique(label)
    }
    most = max(errors, key=lambda group: errors[group])
    return Agreement(float(errors[most]), float(1 - keep.mean()), most, len(keep))


def _slopes(
    case: RolloutLoss,
    middle: Trajectory,
    kind: NDArray[np.str_],
    which: NDArray[np.intp],
    unit: NDArray[np.float64],
    sizes: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Three-point differences (entries, sizes); nan where one of the two runs left the middle's branch.

    Every displaced run is an environment of a batch.
    """
    sim, model = case.sim, case.sim.model
    amounts = np.stack([-sizes, sizes], axis=-1).ravel()
    entry = np.repeat(np.arange(len(kind)), 2 * sizes.shape[1])
    ends, same = np.zeros(len(amounts)), np.zeros(len(amounts), bool)
    many = Simulator(model, num_envs=CHUNK)
    reference = sim.contact_modes(middle)
    for start in range(0, len(amounts), CHUNK):
        chunk = np.arange(start, min(start + CHUNK, len(amounts)))
        moves = {
            k: np.zeros((CHUNK, n))
            for k, n in (("u", case.u.size), ("q", model.nv), ("v", model.nv), ("params", len(model.param_names)))
        }
        for k, move in moves.items():
            rows = np.flatnonzero(kind[entry[chunk]] == k)
            at = entry[chunk[rows]]
            move[rows, which[at]] = amounts[chunk[rows]] * unit[at]
        many.params[:] = sim.params[0] + moves["params"]
        run = many.rollout(
            case.u[:, None] + moves["u"].reshape(CHUNK, *case.u.shape).transpose(1, 0, 2),
            q=retract(model, sim.q[0], moves["q"]),
            v=sim.v + moves["v"],
            anchors=np.repeat(sim.anchors, CHUNK, axis=0),
            anchored=np.repeat(sim.anchored, CHUNK, axis=0),
            history=np.repeat(sim.history, CHUNK, axis=0),
            read_after=case.reads,
        )
        if case.output == "q":
            value = np.array([difference(model, q, middle.q[-1, 0]) for q in run.q[-1]]) @ case.weights
        elif case.output == "v":
            value = (run.v[-1] - middle.v[-1]) @ case.weights
        else:
            value = ((run.tactile[0] - middle.tactile[0]) * case.weights).sum((1, 2))
        unmoved = (many.contact_modes(run) == reference).all(0) & (run.status == 0)
        ends[chunk], same[chunk] = value[: len(chunk)], unmoved[: len(chunk)]
    pairs = np.where(same, ends, np.nan).reshape(*sizes.shape, 2)
    return np.asarray((pairs[..., 1] - pairs[..., 0]) / (2 * sizes))


def difference(model: Any, q: NDArray[np.float64], base: NDArray[np.float64]) -> NDArray[np.float64]:
    """q ⊖ base: the tangent (nv,) from positions `base` (nq,) to positions close to them."""
    straight_q, straight_v = _straight(model)
    result = np.zeros(model.nv)
    for at_q, at_v in quaternion_joints(model):
        vector = _columns(base[at_q : at_q + 4]).T @ q[at_q : at_q + 4]  # sin(angle/2) axis
        length = float(np.linalg.norm(vector))
        result[at_v : at_v + 3] = 2 * vector * (np.arcsin(min(length, 1.0)) / length if length > 1e-12 else 1.0)
    result[straight_v] = (q - base)[straight_q]
    return result
