"""Batched simulation of one scene: state and parameters as NumPy arrays, steps, rollouts and their gradients."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gelflow.errors import SimulationError, UsageError
from gelflow.measurement.machine import default_threads
from gelflow.sim import _core, arguments
from gelflow.sim.arguments import checked, fill, flags, number_array
from gelflow.sim.displacement import marker_displacement
from gelflow.sim.reductions import TactileReduction
from gelflow.sim.simulator_copy import contents, rebuilt
from gelflow.sim.site_poses import site_poses
from gelflow.sim.state_arrays import StateArrays
from gelflow.sim.trajectory import TouchStop, Trajectory, TrajectoryGradient, check_complete, state_rows

STATUS_MESSAGES = {
    0: "ok",
    1: "Newton's method did not converge, even with the shortest substeps",
    2: "a force overflowed",
}


class Buildable(Protocol):
    """An object that builds a core model, such as `gelflow.sim.Scene`."""

    def build(self) -> Any: ...


class Simulator(StateArrays):
    """A batch of N environments of one scene.

    Parameters
    ----------
    scene: a `Scene` or a core model
    num_envs: number of environments N
    threads: maximum number; None: all available cores, at most OMP_NUM_THREADS. Results do not depend on it
    precision: "double" or "single"; None takes the scene's setting, and "double" for a core model

    Attributes
    ----------
    q, v: positions (N, nq), at first the scene's `q0`, and velocities (N, nv); like all state arrays writable views,
        whose elements are set (`sim.q[:] = …`). Then call `clear_history`: anchors and history are of the old state
    params: physical parameters (N, parameters), writable; see `param`
    anchors, anchored: state of the elastic friction law with na anchors, (N, na, 3) [m], and which of them are set,
        (N, na); an anchor that is not set has no meaning
    history: state of BDF2 with nh values, (N, nh): displacement of the previous step (nv), velocity before it (nv), and
        1 if a previous step exists; nh = 0 for BDF1
    status: (N,), 0 or a failure code, see `STATUS_MESSAGES`
    iterations, halved: (N,), Newton iterations and steps that were split into substeps, since the last reset

    In single precision the core stores the rounding residual of `q`, so that small increments accumulate, and computes
    relative poses of bodies in double. Gradients are in double, except the part of viscous marker forces.

    A call during the call of another thread raises UsageError. A signal handler that raises ends a call between two
    steps: each environment then has the state after its last complete step.
    """

    def __init__(
        self,
        scene: Buildable | _core.Model,
        *,
        num_envs: int = 1,
        threads: int | None = None,
        precision: Literal["double", "single"] | None = None,
    ) -> None:
        num_envs = arguments.integer("num_envs", num_envs, minimum=1)
        most = default_threads() if threads is None else arguments.integer("threads", threads, minimum=1)
        if precision is None:
            precision = getattr(scene, "precision", "double")
        if not isinstance(precision, str) or precision not in ("double", "single"):
            raise UsageError(f"precision must be 'double' or 'single', got {arguments.shown(precision)}")
        self.scene: Any = scene  # attributes of a `Scene` are used where present
        if not isinstance(scene, _core.Model) and not hasattr(scene, "build"):
            raise UsageError(f"scene must be a Scene (see load_scene) or a core model, got {arguments.shown(scene)}")
        self.model = scene if isinstance(scene, _core.Model) else scene.build()
        self.dtype: type[Any] = np.float64 if precision == "double" else np.float32
        batch = _core.Batch if precision == "double" else _core.BatchFloat
        self._batch = checked(batch, self.model, num_envs, min(num_envs, most))
        self.num_envs = num_envs
        self._threads = threads
        self.q: NDArray[Any] = self._batch.q
        self.v: NDArray[Any] = self._batch.v
        self.params: NDArray[Any] = self._batch.params
        self.anchors: NDArray[Any] = self._batch.anchors
        self.anchored: NDArray[np.uint8] = self._batch.anchored
        self.history: NDArray[Any] = self._batch.history
        self.status: NDArray[np.int32] = self._batch.status
        self.iterations: NDArray[np.int64] = self._batch.iterations
        self.halved: NDArray[np.int64] = self._batch.halved
        self._tactile: NDArray[Any] | None = None  # created by the first call of `tactile`
        if (start := getattr(scene, "q0", None)) is not None:
            fill("q0 of the scene", self.q[0], start)
            self.q[:] = self.q[0]
            self.step(np.zeros(self.model.nu), 0)  # no step: it sets the positions of coupled joints
        self._start: NDArray[Any] = self.q[0].copy()

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt, contents(self, self._threads)

    @cached_property
    def param_index(self) -> dict[str, int]:
        """Column of `params` for each parameter name."""
        return {name: i for i, name in enumerate(self.model.param_names)}

    def param(self, name: str) -> NDArray[Any]:
        """Values of one parameter, such as "pad_box.kn": a writable view, shape (N,).

        Where elements of different kinds have one name, their kind is given too, as in "pad:finger.kd".
        Raises UsageError for an unknown name.
        """
        if not isinstance(name, str) or name not in self.param_index:
            near = ", ".join(arguments.near_params(name, self.param_index))
            raise UsageError(f"no parameter {arguments.shown(name)}; there are {near}")
        column: NDArray[Any] = self.params[:, self.param_index[name]]
        return column

    def reset(self, which: ArrayLike | None = None) -> None:
        """Return to the start at rest: a scene's `q0`, or the reference configuration of a core model.

        All environments, or those with `which` (N,). History is cleared; parameters keep their values.
        """
        mask = self._mask("which", which)
        checked(self._batch.reset, mask)
        self.q[slice(None) if mask is None else mask.view(bool)] = self._start

    def _mask(self, name: str, mask: ArrayLike | None) -> NDArray[np.uint8] | None:
        """Flags of the environments in `mask` for the core; None: all of them."""
        return None if mask is None else flags(name, mask, self.num_envs).view(np.uint8)

    def clear_history(self, which: ArrayLike | None = None) -> None:
        """Clear friction anchors and the BDF2 history; required after `q` or `v` were written directly."""
        chosen = slice(None) if which is None else flags("which", which, self.num_envs)
        self.anchored[chosen] = 0
        self.history[chosen] = 0

    def step(self, u: ArrayLike, steps: int = 1, *, active: ArrayLike | None = None) -> None:
        """Take `steps` steps with controls u, shape (N, nu), or (nu,) for all environments.

        With a mask `active` (N,), the other environments rest: they keep state and status, and cost nothing.

        An environment that fails keeps its last valid state, gets a nonzero `status` (see `STATUS_MESSAGES`) and does
        not move until `reset`. Raises UsageError when a control or the state is not finite.
        """
        try:
            if active is None:  # the usual case, without the cost of a mask
                self._batch.step(self._controls(u), steps)
            else:
                self._batch.step(self._controls(u), steps, self._mask("active", active))
        except ValueError as error:
            raise UsageError(str(error)) from None
        except TypeError:
            arguments.integer("steps", steps, minimum=0)
            raise

    def _controls(self, u: ArrayLike) -> NDArray[Any]:
        """Controls in the simulator's precision; the core checks their shape."""
        if isinstance(u, np.ndarray) and u.dtype == self.dtype:
            return u
        return number_array("u", u, self.dtype)

    def check(self) -> None:
        """Raises SimulationError that names the first failed environment, if any."""
        failed = np.flatnonzero(self.status)
        if len(failed):
            raise SimulationError(f"environment {failed[0]}: {STATUS_MESSAGES[int(self.status[failed[0]])]}")

    def error_estimate(self, u: ArrayLike) -> NDArray[Any]:
        """Local error of one step with controls u: its positions minus those of two half steps, (N, nv) [m, rad].

        Costs three steps and leaves the state unchanged. For BDF1 the estimate is about half of the local error; for
        BDF2, whose half steps use BDF1, it is an upper estimate. A step that needs substeps is compared with substeps
        of half their length. Raises SimulationError when a step fails.
        """
        estimate, status = checked(self._batch.error_estimate, self._controls(u))
        if failed := np.flatnonzero(status).tolist():
            raise SimulationError(f"environment {failed[0]}: {STATUS_MESSAGES[int(status[failed[0]])]}")
        return np.asarray(estimate)

    def tactile(
        self,
        out: NDArray[Any] | None = None,
        *,
        active: ArrayLike | None = None,
        reduction: TactileReduction | None = None,
    ) -> NDArray[Any]:
        """Marker forces at the present state, (N, markers, 3): shear x, shear y, normal ≥ 0 in compression [N].

        Without `out` the result is the simulator's own array: read-only, and overwritten by the next call. Only changed
        entries are written there, which is faster when few markers are in contact. With a mask `active` (N,), only
        those environments are read; the others keep their values in the array. With a `reduction` the result is (N,
        rows): `out`, or a new array.
        """
        mask = None if active is None else self._mask("active", active)
        if reduction is not None:
            arguments.check_type("reduction", reduction, TactileReduction, "a TactileReduction")
            target = np.zeros((self.num_envs, len(reduction.names)), self.dtype) if out is None else out
            checked(self._batch.reduced_tactile, reduction.core, target, mask)
            return target
        if out is not None:
            checked(self._batch.tactile, out, mask)
            return out
        checked(self._batch.update_readings, mask)
        if self._tactile is None:
            self._tactile = self._batch.readings
        return self._tactile

    def displacement(self, forces: Any = None) -> Any:
        """Displacement of the markers in the gel, (…, markers, 3): along x, along y, into the pad [m].

        At the present state, (N, markers, 3), or for the given marker `forces` (…, markers, 3) [N], such as
        `Trajectory.tactile`. For a torch tensor the result is a tensor and differentiable. Raises UsageError when a pad
        of the scene has no gel.
        """
        return marker_displacement(self.scene, self.tactile() if forces is None else forces, self.dtype)

    def marker_slice(self, name: str) -> slice:
        """Slice of the marker axis that belongs to one pad."""
        first, count = self.model.pad_markers[arguments.index_of("pad", name, self.model.pad_names)]
        return slice(first, first + count)

    def joint_q(self, name: str) -> int:
        """Index in `q` of the first position of a joint."""
        return self._joint(name, self.model.joint_q)

    def joint_v(self, name: str) -> int:
        """Index in `v` of the first velocity of a joint."""
        return self._joint(name, self.model.joint_v)

    def _joint(self, name: str, indices: Sequence[int]) -> int:
        return int(indices[arguments.index_of("joint", name, self.model.joint_names)])

    def poses(self, out: NDArray[Any] | None = None) -> NDArray[Any]:
        """World poses of the moving bodies, (N, bodies, 7): position [m], quaternion w x y z; a new array, or `out`."""
        target = np.empty((self.num_envs, len(self.model.body_names), 7), self.dtype) if out is None else out
        checked(self._batch.poses, target)
        return target

    def site_poses(self, q: ArrayLike | None = None) -> NDArray[Any]:
        """World poses of the sites, in the order of `Scene.sites`: (N, sites, 7), position [m] and quaternion w x y z.

        At the present positions, or with another leading shape at `q` (…, N, nq), such as `Trajectory.q`. Raises
        UsageError for a scene without sites. Differentiable: `torch_site_poses`.
        """
        if q is None:
            self.step(np.zeros(self.model.nu), 0)  # no step: it sets the positions of coupled joints
        poses = site_poses(self.scene, self.model, self.params, self.q if q is None else q)
        return poses.astype(self.dtype, copy=False)

    def wrenches(self, out: NDArray[Any] | None = None) -> NDArray[Any]:
        """Contact wrenches on the first body of each contact, about the world origin, (N, contacts, 6).

        Moment [N m], then force [N]; a new array, or `out`.
        """
        target = np.empty((self.num_envs, len(self.model.contact_names), 6), self.dtype) if out is None else out
        checked(self._batch.wrenches, target)
        return target

    def contact_forces(self) -> NDArray[Any]:
        """Generalized contact forces Jᵀ f of all contacts at the present state, (N, nv) [N, N m]."""
        out = np.empty((self.num_envs, self.model.nv), self.dtype)
        checked(self._batch.contact_forces, out)
        return out

    def mass_matrix(self) -> NDArray[Any]:
        """Joint-space mass matrix M(q), (N, nv, nv)."""
        out = np.empty((self.num_envs, self.model.nv, self.model.nv), self.dtype)
        checked(self._batch.mass_matrix, out)
        return out

    def bias(self) -> NDArray[Any]:
        """Coriolis, centrifugal and gravity forces C(q, v), (N, nv)."""
        out = np.empty((self.num_envs, self.model.nv), self.dtype)
        checked(self._batch.bias, out)
        return out

    def rollout(
        self,
        u: ArrayLike,
        *,
        q: ArrayLike | None = None,
        v: ArrayLike | None = None,
        anchors: ArrayLike | None = None,
        anchored: ArrayLike | None = None,
        history: ArrayLike | None = None,
        read_after: Sequence[int] = (),
        reduction: TactileReduction | None = None,
        active: ArrayLike | None = None,
        stop: TouchStop | None = None,
        end_only: bool = False,
        out: Trajectory | None = None,
    ) -> Trajectory:
        """Record steps with controls u (steps, N, nu), from the given or the present state; the state is not changed.

        Parameters
        ----------
        u: controls of each step
        q, v, anchors, anchored, history: initial state; those of the simulator by default
        read_after: numbers of steps after which marker forces are read (0 is the start)
        reduction: record this function of the marker forces instead of the forces
        active: mask (N,); the others rest, cost nothing, and have readings of zero, or with `out` those in `out`
        stop: stops environments on touch
        end_only: record the last state only, which saves memory and time; such a rollout has no gradient
        out: an earlier trajectory of the same shape whose arrays are overwritten, by a refused call too; saves time

        Raises UsageError for wrong shapes and for values that are not finite.
        """
        controls = np.array(number_array("u", u, self.dtype), order="C")  # a copy: the caller may change u afterwards
        if controls.ndim != 3 or controls.shape[1:] != (self.num_envs, self.model.nu):
            raise UsageError(f"u must have shape (steps, {self.num_envs}, {self.model.nu}), got {controls.shape}")
        arguments.check_optional(stop=(stop, TouchStop), reduction=(reduction, TactileReduction), out=(out, Trajectory))
        if stop is not None and not self.model.num_markers:
            raise UsageError("a touch stop needs a scene with pads")
        reads = arguments.integers("read_after", read_after)
        steps, n = controls.shape[0], self.num_envs
        rows = 1 if arguments.flag("end_only", end_only) else steps + 1
        reading = (self.model.num_markers, 3) if reduction is None else (len(reduction.names),)
        tactile_shape = (len(reads), n, *reading)
        if out is not None:
            out.check_reusable(controls.shape, rows, tactile_shape)
        mask = self._mask("active", active)
        empty = np.empty if mask is None else np.zeros
        start = {"q": q, "v": v, "anchors": anchors, "anchored": anchored, "history": history}
        result = Trajectory(
            **{name: state_rows(name, value, getattr(self, name), rows, out) for name, value in start.items()},
            u=controls,
            tactile=out.tactile if out is not None else empty(tactile_shape, self.dtype),
            read_after=reads,
            halvings=np.zeros((steps, n), np.int8),
            status=np.zeros(n, np.int32),
            active=np.ones(n, np.uint8) if mask is None else mask.copy(),
            stopped_at=np.full(n, -1, np.int32),
            reduction=reduction,
        )
        checked(self._batch.rollout, result.core(), None if stop is None else stop.core(n, steps))
        return result

    def contact_modes(self, trajectory: Trajectory) -> NDArray[np.uint64]:
        """Contact mode signature of each step (contact, slip and clipping of every point and actuator), (steps, N).

        Two rollouts with equal signatures lie on the same smooth piece of the dynamics. Markers are included in steps
        after which they were read.
        """
        check_complete(trajectory)
        return np.asarray(checked(self._batch.contact_modes, trajectory.core()))

    def rollout_gradient(
        self,
        trajectory: Trajectory,
        *,
        q: ArrayLike | None = None,
        v: ArrayLike | None = None,
        tactile: ArrayLike | None = None,
        anchors_end: ArrayLike | None = None,
        history_end: ArrayLike | None = None,
        params: bool = False,
    ) -> TrajectoryGradient:
        """Reverse pass (adjoint) of a rollout.

        Parameters
        ----------
        trajectory: result of `rollout`
        q, v, tactile: gradients of the scalar with respect to these arrays of the trajectory, broadcast to their shape
        anchors_end, history_end: gradients with respect to the final `anchors` and `history`
        params: also compute the gradient with respect to all physical parameters, at many times the cost

        The simulator must have the parameters of the rollout. An environment that stopped is differentiated as the
        steps that it took: the number of steps is a constant. Failed environments have gradient zero.
        """
        check_complete(trajectory)

        def shaped(value: ArrayLike | None, like: NDArray[Any]) -> NDArray[Any]:
            if value is None:
                return np.zeros(like.shape, self.dtype)
            array = number_array("a gradient", value, self.dtype)
            if array.shape != like.shape:
                full = np.empty(like.shape, self.dtype)
                fill("a gradient", full, array)
                array = full
            return np.ascontiguousarray(array)

        cotangent = _core.TrajectoryCotangent(
            q=shaped(q, trajectory.q),
            v=shaped(v, trajectory.v),
            anchors_end=shaped(anchors_end, trajectory.anchors[0]),
            history_end=shaped(history_end, trajectory.history[0]),
            tactile=shaped(tactile, trajectory.tactile),
        )
        g = checked(self._batch.rollout_vjp, trajectory.core(), cotangent, arguments.flag("params", params))
        return TrajectoryGradient(u=g.u, q=g.q, v=g.v, anchors=g.anchors, history=g.history, params=g.params)
