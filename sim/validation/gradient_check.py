"""Verification of gradients: reverse pass against dual numbers and against central differences.

The checked scalar is a random linear function of one part of the end of a rollout (positions, velocities or marker
forces). The reverse pass gives its gradient with respect to controls, initial state and parameters.

* Dual numbers run the same core with the same contact modes and give the exact derivative along a direction. Agreement
  to rounding verifies all analytic derivatives and the reverse pass.
* Central differences are independent of the derivation. A stencil with runs in other contact modes than the base point
  measures a kink instead of a derivative; it is skipped and counted.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import SimulationError
from gelflow.sim import _core
from gelflow.sim.reductions import TactileReduction
from gelflow.sim.simulator import Simulator
from gelflow.sim.trajectory import TouchStop, Trajectory

Output = Literal["q", "v", "tactile"]


@dataclass(frozen=True)
class Agreement:
    """Agreement of two gradients."""

    error: float  # norm of the difference relative to the norm of the gradient
    skipped: float  # share of entries for which all stencils crossed a kink (0 for dual numbers)
    worst: str = ""  # input with the largest error: "u", "q", "v", or a group of parameters
    entries: int = 0  # number of gradient entries


def quaternion_joints(model: Any) -> list[tuple[int, int]]:
    """Index of the quaternion in q, and of the angular velocity in v, for each ball and free joint."""
    ends = [*list(model.joint_q)[1:], model.nq]
    widths = [end - q for q, end in zip(model.joint_q, ends, strict=True)]
    return [
        (q + width - 4, v + width - 4)  # in a free joint they follow the three linear components
        for q, v, width in zip(model.joint_q, model.joint_v, widths, strict=True)
        if width >= 4
    ]


def _linear_dofs(model: Any) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Masks of q and v without quaternions and their angular velocities."""
    linear_q, linear_v = np.ones(model.nq, bool), np.ones(model.nv, bool)
    for at_q, at_v in quaternion_joints(model):
        linear_q[at_q : at_q + 4] = False
        linear_v[at_v : at_v + 3] = False
    return linear_q, linear_v


def _tangent_basis(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrix (4, 3) of the linear map δ → quaternion ⊗ (0, δ); its columns are orthonormal."""
    w, x, y, z = quaternion
    return np.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]])


def _rotate_by(quaternion: NDArray[np.float64], by: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternions (…, 4) ⊗ exp(by), with rotation vectors `by` (…, 3) [rad]."""
    angle = np.linalg.norm(by, axis=-1, keepdims=True)
    scale = np.where(angle > 1e-12, np.sin(angle / 2) / np.maximum(angle, 1e-12), 0.5)
    w, x = np.cos(angle / 2), by * scale
    a, b = quaternion[..., :1], quaternion[..., 1:]
    scalar = a * w - (b * x).sum(-1, keepdims=True)
    return np.concatenate([scalar, a * x + w * b + np.cross(b, x)], axis=-1)


def retract(model: Any, q: NDArray[np.float64], tangent: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions q (…, nq) ⊕ tangent vectors (…, nv)."""
    q, tangent = np.broadcast_to(q, (*tangent.shape[:-1], model.nq)).copy(), np.asarray(tangent)
    linear_q, linear_v = _linear_dofs(model)
    for at_q, at_v in quaternion_joints(model):
        q[..., at_q : at_q + 4] = _rotate_by(q[..., at_q : at_q + 4], tangent[..., at_v : at_v + 3])
    q[..., linear_q] += tangent[..., linear_v]
    return q


def to_tangent(model: Any, q: NDArray[np.float64], gradient: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gradient with respect to the tangent (nv,) from the gradient with respect to q (nq,)."""
    linear_q, linear_v = _linear_dofs(model)
    result = np.zeros(model.nv)
    for at_q, at_v in quaternion_joints(model):
        result[at_v : at_v + 3] = 0.5 * _tangent_basis(q[at_q : at_q + 4]).T @ gradient[at_q : at_q + 4]
    result[linear_v] = gradient[linear_q]
    return result


@dataclass(frozen=True)
class RolloutLoss:
    """A rollout from the present state of a simulator, and a linear scalar function of its end."""

    sim: Simulator  # one environment, double precision
    u: NDArray[np.float64]  # (steps, nu)
    output: Output
    weights: NDArray[np.float64]  # of the scalar: (nv,) for the tangent of q, (nv,) for v, (markers, 3) or (rows,)
    reduction: TactileReduction | None = None  # of the marker forces
    stop: TouchStop | None = None

    @classmethod
    def random(
        cls, sim: Simulator, u: NDArray[np.float64], output: Output, rng: np.random.Generator, **options: Any
    ) -> "RolloutLoss":
        """A loss with normally distributed weights; `options`: reduction, stop."""
        reduction = options.get("reduction")
        reading = (sim.model.num_markers, 3) if reduction is None else (len(reduction.names),)
        return cls(sim, u, output, rng.normal(size=reading if output == "tactile" else sim.model.nv), **options)

    @property
    def reads(self) -> tuple[int, ...]:
        """Steps after which marker forces are evaluated."""
        return (len(self.u),) if self.output == "tactile" else ()


def reverse_gradient(loss: RolloutLoss, *, params: bool = False) -> tuple[Trajectory, dict[str, NDArray[np.float64]]]:
    """The rollout and its gradient from the reverse pass.

    Keys: "u" (steps, nu), "q" (nv,) on the tangent, "v" (nv,), "anchors" (na, 3), "history" (nh,), and with `params`
    "params" (parameters,). Raises SimulationError when the rollout fails.
    """
    sim, model = loss.sim, loss.sim.model
    trajectory = sim.rollout(loss.u[:, None], read_after=loss.reads, reduction=loss.reduction, stop=loss.stop)
    if trajectory.status[0]:
        raise SimulationError("the rollout of the gradient check failed")
    by: dict[str, NDArray[np.float64]] = {}
    if loss.output == "q":
        by["q"] = np.zeros_like(trajectory.q)
        by["q"][-1, 0] = _from_tangent(model, trajectory.q[-1, 0], loss.weights)
    elif loss.output == "v":
        by["v"] = np.zeros_like(trajectory.v)
        by["v"][-1, 0] = loss.weights
    else:
        by["tactile"] = loss.weights[None, None]
    g = sim.rollout_gradient(trajectory, params=params, **by)
    start = to_tangent(model, trajectory.q[0, 0], g.q[0])
    gradient = {"u": g.u[:, 0], "q": start, "v": g.v[0], "anchors": g.anchors[0], "history": g.history[0]}
    return trajectory, {**gradient, "params": g.params[0]} if params else gradient


def _from_tangent(model: Any, q: NDArray[np.float64], tangent: NDArray[np.float64]) -> NDArray[np.float64]:
    linear_q, linear_v = _linear_dofs(model)
    result = np.zeros(model.nq)
    for at_q, at_v in quaternion_joints(model):
        result[at_q : at_q + 4] = 2 * _tangent_basis(q[at_q : at_q + 4]) @ tangent[at_v : at_v + 3]
    result[linear_q] = tangent[linear_v]
    return result


def compare_to_dual_numbers(
    loss: RolloutLoss, rng: np.random.Generator, *, directions: int = 3, groups: bool = True
) -> Agreement:
    """Largest relative error of directional derivatives, along random directions.

    Directions are in u, q, v, anchors, history and params, each alone and all together, and with `groups` once in each
    parameter group (`parameter_groups`). Verifies the adjoint identity ⟨w, J d⟩ = ⟨Jᵀ w, d⟩ with J d from dual numbers
    and Jᵀ w from the reverse pass. Raises SimulationError when a run fails.
    """
    sim, model = loss.sim, loss.sim.model
    trajectory, gradient = reverse_gradient(loss, params=True)
    set_now = sim.anchored[0].astype(bool)
    parts = ["u", "q", "v", "params"]
    parts += ["anchors"] * bool(set_now.any()) + ["history"] * bool(sim.history[0].any())
    scale, group = parameter_scales(model, sim.params[0]), parameter_groups(model)
    tries = [(only, group == only) for only in np.unique(group)] if groups else []
    tries += [(only, np.ones(len(scale), bool)) for only in [*parts, "all"]] * directions
    taken = slice(trajectory.stopped_at[0] if trajectory.stopped_at[0] >= 0 else None)  # steps before a touch stop
    drawn: list[dict[str, Any]] = []
    for only, chosen in tries:
        d = {name: np.zeros_like(value) for name, value in gradient.items()}
        for name in parts if only == "all" else [only if only in parts else "params"]:
            d[name] = rng.normal(size=d[name].shape)
        d["anchors"][~set_now] = 0
        d["params"] *= scale * chosen
        d["history"][-1:] = 0  # flag of an existing previous step
        drawn.append(d)
    now = {name: getattr(sim, name)[0] for name in ("params", "q", "v", "anchors", "anchored", "history")}
    start = _core.RolloutInput(**now, u=loss.u[taken])
    exact = _core.directional_rollout(model, start, [_core.RolloutInput(**{**d, "u": d["u"][taken]}) for d in drawn])
    if np.abs(exact.end.q - trajectory.q[-1, 0]).max() > 1e-9:
        raise SimulationError("the run with dual numbers differs from the recorded run")
    differences: list[tuple[str, float, float]] = []  # input, difference, size
    for (only, _), d, end in zip(tries, drawn, exact.derivatives, strict=True):
        derivative = getattr(end, loss.output)
        if loss.output == "tactile" and loss.reduction is not None:
            derivative = loss.reduction(derivative.reshape(-1, 3))
        along = loss.weights.ravel() @ derivative
        size = np.linalg.norm(loss.weights) * np.linalg.norm(derivative)
        ours = sum(float((gradient[name] * d[name]).sum()) for name in gradient)
        differences.append((str(only), abs(float(along) - ours), float(size)))
    floor = 1e-6 * max(size for *_, size in differences) + 1e-300  # below it rounding errors dominate
    error, most = max((difference / max(size, floor), only) for only, difference, size in differences)
    return Agreement(float(error), 0.0, most)


def parameter_groups(model: Any) -> NDArray[np.str_]:
    """Group of each parameter: "kn", "pos", "inertia", "gravity", …; (parameters,)."""
    return np.array(
        [next(part for part in reversed(name.split(".")) if part not in _COMPONENTS) for name in model.param_names]
    )


_COMPONENTS = ("x", "y", "z", "xx", "yy", "zz", "xy", "xz", "yz")


def parameter_scales(model: Any, params: NDArray[np.float64]) -> NDArray[np.float64]:
    """Displacement scale of each parameter: its magnitude, or a typical one for its group if it is zero.

    0 for parameters that cannot be displaced: infinite bounds, and sizes that a shape does not have.
    """
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


# Stencil sizes: the first one, and quarters of it. An entry starts with the first three sizes; if these cross a kink or
# disagree, three smaller ones follow, and so on.
STENCIL = {"u": 1e-3, "q": 5e-6, "v": 1e-3, "params": 1e-3}  # first size: [as u], [m or rad], [m/s or rad/s], relative
RATIO, ROUNDS, PER_ROUND = 4, 5, 3
AGREE = 1e-8  # difference of two sufficient estimates, relative to the gradient
CHUNK = 128  # environments per batch

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class _Entries:
    """Gradient entries to compare."""

    kind: NDArray[np.str_]  # "u", "q", "v" or "params"
    index: NDArray[np.intp]  # in the flattened input of this kind
    unit: Floats  # displacement unit; `parameter_scales` for parameters
    gradient: Floats  # from the reverse pass, times the unit
    group: NDArray[np.str_]  # kind, or parameter group

    def norms(self, values: Floats) -> Floats:
        """Norm of the group of each entry; for parameter groups at least 1e-3 of the norm of all parameters."""
        floor = 1e-3 * np.linalg.norm(values[self.kind == "params"])
        sums = {group: np.linalg.norm(values[self.group == group]) for group in np.unique(self.group)}
        return np.array(
            [max(float(sums[g]), floor if k == "params" else 0.0) for g, k in zip(self.group, self.kind, strict=True)]
        )


def compare_to_differences(loss: RolloutLoss, *, params: bool = True) -> Agreement:
    """Compare the gradient with respect to (u, q, v, params) with five-point central differences, entry by entry.

    The error is the largest of the relative errors of u, q, v and the parameter groups, which have different units.
    Parameters count in multiples of `parameter_scales`. The norm of a parameter group counts at least as a thousandth
    of that of all parameters. Entries without two stencils on one smooth piece of the dynamics are skipped.
    """
    middle, gradient = reverse_gradient(loss, params=params)
    entries = _entries(loss, gradient, params=params)
    estimate, spread = _differences(loss, middle, entries)
    keep = np.isfinite(spread)
    norms = entries.norms(entries.gradient)
    errors = {
        str(group): np.linalg.norm((estimate - entries.gradient)[keep & (entries.group == group)])
        / max(norms[entries.group == group][0], 1e-300)
        for group in np.unique(entries.group)
    }
    worst = max(errors, key=lambda group: errors[group])
    return Agreement(float(errors[worst]), float(1 - keep.mean()), worst, len(keep))


def _entries(loss: RolloutLoss, gradient: dict[str, Floats], *, params: bool) -> _Entries:
    """All entries whose unit is not zero."""
    model = loss.sim.model
    kinds = ["u", "q", "v"] + ["params"] * params
    scale = {k: np.ones(gradient[k].size) for k in kinds}
    if params:
        scale["params"] = parameter_scales(model, loss.sim.params[0])
        scale["params"][(parameter_groups(model) == "frictionloss") & (loss.sim.params[0] == 0)] = 0  # never negative
    index = np.concatenate([np.flatnonzero(scale[k]) for k in kinds])
    kind = np.concatenate([np.full(int((scale[k] != 0).sum()), k) for k in kinds])
    unit = np.concatenate([scale[k][scale[k] != 0] for k in kinds])
    analytic = np.concatenate([gradient[k].ravel()[scale[k] != 0] for k in kinds]) * unit
    group = kind.copy()
    if params:
        group = np.where(kind == "params", parameter_groups(model)[index * (kind == "params")], kind)
    return _Entries(kind, index, unit, analytic, group)


def _differences(loss: RolloutLoss, middle: Trajectory, entries: _Entries) -> tuple[Floats, Floats]:
    """Best five-point difference of each entry, and its uncertainty; nan and inf without two valid stencils.

    A five-point difference combines two three-point ones, of sizes s and s/4. Of the sizes whose runs stay in the
    contact modes of `middle`, the one with the smallest uncertainty is taken, where rounding and truncation balance.
    Smaller sizes are tried only while the larger ones cross a kink or disagree. The analytic gradient is not used.
    """
    first = np.array([STENCIL[k] for k in entries.kind])
    slopes = np.full((len(first), 1 + ROUNDS * PER_ROUND), np.nan)  # three-point; nan: crossed a kink, or not tried
    best, spread = np.full(len(first), np.nan), np.full(len(first), np.inf)
    for done in range(ROUNDS):
        todo = np.flatnonzero(~(spread <= AGREE * entries.norms(np.nan_to_num(best))))
        columns = slice(done * PER_ROUND, (done + 1) * PER_ROUND)
        sizes = first[todo, None] / float(RATIO) ** np.arange(columns.start, columns.stop)
        slopes[todo, columns] = _slopes(
            loss, middle, entries.kind[todo], entries.index[todo], entries.unit[todo], sizes
        )
        estimates = (RATIO**2 * slopes[todo, 1:] - slopes[todo, :-1]) / (RATIO**2 - 1)
        uncertainty = _uncertainty(np.abs(np.diff(estimates, axis=1)))
        chosen = np.arange(len(todo)), uncertainty.argmin(1)
        spread[todo], best[todo] = uncertainty[chosen], estimates[chosen]
    return best, spread


def _uncertainty(differences: Floats) -> Floats:
    """Uncertainty of estimates from their differences to the next smaller size, (entries, sizes).

    Two estimates can agree by chance, so that smaller sizes also bound the rounding error, which grows by `RATIO` from
    one size to the next.
    """
    result = differences.copy()
    # A difference that grew from one size to the next is rounding, and no smaller size has less of it.
    grown = np.where(differences[:, 1:] > differences[:, :-1], differences[:, 1:], 0.0)
    result[:, 1:] = np.fmax(result[:, 1:], np.maximum.accumulate(grown, axis=1))
    for column in range(result.shape[1] - 2, -1, -1):
        result[:, column] = np.fmax(result[:, column], result[:, column + 1] / RATIO)
    result[np.isnan(differences)] = np.inf
    return result


def _slopes(
    loss: RolloutLoss,
    middle: Trajectory,
    kind: NDArray[np.str_],
    index: NDArray[np.intp],
    unit: NDArray[np.float64],
    sizes: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Three-point differences (entries, sizes); nan where a run leaves the contact modes of `middle`.

    Displaced runs are simulated as environments of a batch.
    """
    sim, model = loss.sim, loss.sim.model
    amounts = np.stack([-sizes, sizes], axis=-1).ravel()
    entry = np.repeat(np.arange(len(kind)), 2 * sizes.shape[1])
    ends, same = np.zeros(len(amounts)), np.zeros(len(amounts), bool)
    many = Simulator(model, num_envs=CHUNK)
    many._batch.checks_params = False  # parameters are displaced to both sides of zero
    reference = sim.contact_modes(middle)
    for start in range(0, len(amounts), CHUNK):
        chunk = np.arange(start, min(start + CHUNK, len(amounts)))
        moves = {
            k: np.zeros((CHUNK, n))
            for k, n in (("u", loss.u.size), ("q", model.nv), ("v", model.nv), ("params", len(model.param_names)))
        }
        for k, move in moves.items():
            rows = np.flatnonzero(kind[entry[chunk]] == k)
            at = entry[chunk[rows]]
            move[rows, index[at]] = amounts[chunk[rows]] * unit[at]
        many.params[:] = sim.params[0] + moves["params"]
        run = many.rollout(
            loss.u[:, None] + moves["u"].reshape(CHUNK, *loss.u.shape).transpose(1, 0, 2),
            q=retract(model, sim.q[0], moves["q"]),
            v=sim.v + moves["v"],
            anchors=np.repeat(sim.anchors, CHUNK, axis=0),
            anchored=np.repeat(sim.anchored, CHUNK, axis=0),
            history=np.repeat(sim.history, CHUNK, axis=0),
            read_after=loss.reads,
            reduction=loss.reduction,
            stop=loss.stop,
        )
        if loss.output == "q":
            value = np.array([difference(model, q, middle.q[-1, 0]) for q in run.q[-1]]) @ loss.weights
        elif loss.output == "v":
            value = (run.v[-1] - middle.v[-1]) @ loss.weights
        else:
            value = ((run.tactile[0] - middle.tactile[0]) * loss.weights).reshape(CHUNK, -1).sum(1)
        same_modes = (many.contact_modes(run) == reference).all(0) & (run.status == 0)
        ends[chunk], same[chunk] = value[: len(chunk)], same_modes[: len(chunk)]
    pairs = np.where(same, ends, np.nan).reshape(*sizes.shape, 2)
    return np.asarray((pairs[..., 1] - pairs[..., 0]) / (2 * sizes))


def difference(model: Any, q: NDArray[np.float64], base: NDArray[np.float64]) -> NDArray[np.float64]:
    """q ⊖ base: tangent vector (nv,) from positions `base` (nq,) to nearby positions q (nq,)."""
    linear_q, linear_v = _linear_dofs(model)
    result = np.zeros(model.nv)
    for at_q, at_v in quaternion_joints(model):
        vector = _tangent_basis(base[at_q : at_q + 4]).T @ q[at_q : at_q + 4]  # sin(angle/2) axis
        length = float(np.linalg.norm(vector))
        result[at_v : at_v + 3] = 2 * vector * (np.arcsin(min(length, 1.0)) / length if length > 1e-12 else 1.0)
    result[linear_v] = (q - base)[linear_q]
    return result
