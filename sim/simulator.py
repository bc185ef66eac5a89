"""The simulator's handle: N copies of a scene that step together, with NumPy arrays in and out."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gelflow.errors import SimulationError, UsageError
from gelflow.sim import _core

STATUS_MESSAGES = {
    0: "ok",
    1: "Newton's method did not converge, even with the shortest substeps",
    2: "a force overflowed",
}


class Buildable(Protocol):
    """Anything that makes a core model: a `gelflow.sim.scene.scene.Scene`."""

    def build(self) -> Any: ...


@dataclass(frozen=True)
class Trajectory:
    """A recorded rollout; arrays have time first, then environment."""

    q: NDArray[Any]  # (steps + 1, N, nq)
    v: NDArray[Any]  # (steps + 1, N, nv)
    anchors: NDArray[Any]  # (steps + 1, N, na, 3), in the frames of the shapes that are touched [m]
    anchored: NDArray[np.uint8]  # (steps + 1, N, na)
    history: NDArray[Any]  # (steps + 1, N, nh): what BDF2 remembers of the step before, see `Simulator`
    u: NDArray[Any]  # (steps, N, nu)
    tactile: NDArray[Any]  # (reads, N, markers, 3): shear x, shear y, normal [N]
    read_after: NDArray[np.int32]  # markers were read after that many steps
    halvings: NDArray[np.int8]  # (steps, N): the step was taken as 2^halvings substeps
    status: NDArray[np.int32]  # (N): 0, or why the environment stopped (`STATUS_MESSAGES`)


@dataclass(frozen=True)
class TrajectoryGradient:
    """Gradient of a scalar with respect to what a rollout was given; a quaternion's is its tangent gradient."""

    u: NDArray[Any]  # (steps, N, nu)
    q: NDArray[Any]  # (N, nq)
    v: NDArray[Any]  # (N, nv)
    anchors: NDArray[Any]  # (N, na, 3)
    history: NDArray[Any]  # (N, nh)
    params: NDArray[np.float64]  # (N, parameters), in the order of `Model.param_names`; (N, 0) where not asked for


class Simulator:
    """N environments of one scene.

    Parameters
    ----------
    scene: a `Scene` (or a core model)
    num_envs: how many copies
    threads: at most this many threads; all cores when None. Results do not depend on it.
    precision: "double" or "single"; when None as the scene says, "double" for a core model

    `q` (N, nq), `v` (N, nv) and `params` (N, parameters) are the simulator's own memory: write into them. So are
    `anchors` (N, na, 3) and `anchored` (N, na), the memory of the elastic friction law, and `history` (N, nh), that of
    BDF2: last step's displacement (nv), the velocity before it (nv), and 1 where there was one; BDF1 has none, nh = 0.

    In single precision the core keeps what `q` rounds away, so that small steps add up, and sees bodies from each other
    in double; gradients are computed in double, at the states of the trajectory, but for viscous readings' share.
    """

    def __init__(
        self,
        scene: Any,
        *,
        num_envs: int = 1,
        threads: int | None = None,
        precision: Literal["double", "single"] | None = None,
    ) -> None:
        if num_envs < 1:
            raise UsageError(f"num_envs must be at least 1, got {num_envs}")
        if precision is None:
            precision = getattr(scene, "precision", "double")
        if precision not in ("double", "single"):
            raise UsageError(f"precision must be 'double' or 'single', got {precision!r}")
        self.scene = scene
        self.model = scene if isinstance(scene, _core.Model) else scene.build()
        self.dtype: type[Any] = np.float64 if precision == "double" else np.float32
        available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        workers = max(1, min(num_envs, threads or available))
        batch = _core.Batch if precision == "double" else _core.BatchFloat
        self._batch = batch(self.model, num_envs, workers)
        self.num_envs = num_envs
        self.q: NDArray[Any] = self._batch.q
        self.v: NDArray[Any] = self._batch.v
        self.params: NDArray[Any] = self._batch.params
        self.anchors: NDArray[Any] = self._batch.anchors
        self.anchored: NDArray[np.uint8] = self._batch.anchored
        self.history: NDArray[Any] = self._batch.history
        self.status: NDArray[np.int32] = self._batch.status
        self.iterations: NDArray[np.int64] = self._batch.iterations
        self.halved: NDArray[np.int64] = self._batch.halved
        self._readings: NDArray[Any] | None = None  # there from the first reading on

    @cached_property
    def param_index(self) -> dict[str, int]:
        """Which column of `params` a parameter is."""
        return {name: i for i, name in enumerate(self.model.param_names)}

    def param(self, name: str) -> NDArray[Any]:
        """The column of one parameter, such as "pad_box.kn": a view of shape (N,) to read and write.

        Raises UsageError for a name that the scene does not have.
        """
        if name not in self.param_index:
            owner = name.split(".")[0]
            near = [n for n in self.param_index if n.startswith(owner + ".")] or sorted(
                {n.split(".")[0] for n in self.param_index}
            )
            raise UsageError(f"no parameter {name!r}; there are {', '.join(near)}")
        column: NDArray[Any] = self.params[:, self.param_index[name]]
        return column

    def reset(self, which: ArrayLike | None = None) -> None:
        """Reference positions, rest and no memory of contact, for environments where `which` (N,) is true, or all.

        Parameters keep their values.
        """
        self._batch.reset(None if which is None else np.ascontiguousarray(which, dtype=np.uint8))

    def clear_history(self, which: ArrayLike | None = None) -> None:
        """Clear what the state remembers of its past, after it was written by hand: anchors, and BDF2's history."""
        chosen = slice(None) if which is None else np.asarray(which, dtype=bool)
        self.anchored[chosen] = 0
        self.history[chosen] = 0

    def step(self, u: ArrayLike, steps: int = 1) -> None:
        """Take `steps` steps under controls u (N, nu), or (nu,) for all environments alike.

        An environment that fails keeps its last good state and gets a `status` other than 0 (see `STATUS_MESSAGES`); it
        stays still until `reset`. Raises UsageError when a control or the state is not finite.
        """
        try:
            self._batch.step(self._numbers(u), steps)
        except ValueError as error:
            raise UsageError(str(error)) from None

    def _numbers(self, u: ArrayLike) -> NDArray[Any]:
        """As the core takes them, which looks at their shape and their order."""
        if isinstance(u, np.ndarray) and u.dtype == self.dtype:
            return u
        try:
            return np.asarray(u, dtype=self.dtype)
        except (TypeError, ValueError) as error:
            raise UsageError(f"u must be numbers: {error}") from None

    def check(self) -> None:
        """Raises SimulationError when an environment has failed, naming the first."""
        failed = np.flatnonzero(self.status)
        if len(failed):
            raise SimulationError(f"environment {failed[0]}: {STATUS_MESSAGES[int(self.status[failed[0]])]}")

    def error_estimate(self, u: ArrayLike) -> NDArray[Any]:
        """What one step under u would be off by: its positions less those of two half steps, (N, nv) [m, rad].

        Costs three steps and changes nothing. Under BDF1 it is about half of the step's own error; under BDF2, whose
        half steps are BDF1's, it is an upper estimate. A step that has to be halved is compared with parts half as long
        as its shortest. Raises SimulationError where a step can not be taken.
        """
        try:
            estimate, status = self._batch.error_estimate(self._numbers(u))
        except ValueError as error:
            raise UsageError(str(error)) from None
        if failed := np.flatnonzero(status).tolist():
            raise SimulationError(f"environment {failed[0]}: {STATUS_MESSAGES[int(status[failed[0]])]}")
        return np.asarray(estimate)

    def tactile(self, out: NDArray[Any] | None = None) -> NDArray[Any]:
        """Marker readings now, (N, markers, 3): shear x, shear y, normal ≥ 0 in compression [N].

        Without `out` the array is the simulator's own: read-only, and overwritten by the next call. Only what changes
        is written there, which is faster where few markers touch.
        """
        if out is not None:
            self._batch.tactile(out)
            return out
        self._batch.tactile()
        if self._readings is None:
            self._readings = self._batch.readings
        return self._readings

    def displacement(self, forces: Any = None) -> Any:
        """How far the markers go in their gels, (…, markers, 3): along x, along y, into the pad [m].

        Now, (N, markers, 3), or under other `forces` [N] (…, markers, 3), such as `Trajectory.tactile`. A tensor gives
        a tensor, with its gradient. Raises UsageError where a pad of the scene has no gel.
        """
        pads = getattr(self.scene, "pads", ())
        if not pads:
            raise UsageError("displacement needs a scene with pads")
        if bare := [pad.name for pad in pads if pad.gel is None]:
            raise UsageError(f"pad {bare[0]!r} has no gel; give pads.{bare[0]}.gel in the scene")
        felt = self.tactile() if forces is None else forces
        if not hasattr(felt, "requires_grad"):
            felt = np.asarray(felt, self.dtype)
        if felt.ndim < 2 or tuple(felt.shape[-2:]) != (self.model.markers, 3):
            raise UsageError(f"forces must have shape (…, {self.model.markers}, 3), got {tuple(felt.shape)}")
        moved = [pad.gel.displacement(felt[..., self.pad(pad.name), :]) for pad in pads]
        if isinstance(felt, np.ndarray):
            return np.concatenate(moved, axis=-2)
        import torch  # here: who has no tensors needs no torch

        return torch.cat(moved, dim=-2)

    def pad(self, name: str) -> slice:
        """The markers of one pad, as a slice of the markers' axis."""
        names = list(self.model.pad_names)
        if name not in names:
            raise UsageError(f"no pad {name!r}; there are {', '.join(names)}")
        first, count = self.model.pad_markers[names.index(name)]
        return slice(first, first + count)

    def joint_q(self, name: str) -> int:
        """Index into q of a joint's first position."""
        return self._joint(name, self.model.joint_q)

    def joint_v(self, name: str) -> int:
        """Index into v of a joint's first velocity."""
        return self._joint(name, self.model.joint_v)

    def _joint(self, name: str, indices: Sequence[int]) -> int:
        names = list(self.model.joint_names)
        if name not in names:
            raise UsageError(f"no joint {name!r}; there are {', '.join(names)}")
        return int(indices[names.index(name)])

    def poses(self, out: NDArray[Any] | None = None) -> NDArray[Any]:
        """Poses of the moving bodies in the world, (N, bodies, 7): position [m], quaternion w x y z.

        A new array each time, or `out`.
        """
        target = np.empty((self.num_envs, len(self.model.body_names), 7), self.dtype) if out is None else out
        self._batch.poses(target)
        return target

    def wrenches(self, out: NDArray[Any] | None = None) -> NDArray[Any]:
        """Per contact, on its first body, about the world's origin, (N, contacts, 6): moment [N m], force [N].

        A new array each time, or `out`.
        """
        target = np.empty((self.num_envs, len(self.model.contact_names), 6), self.dtype) if out is None else out
        self._batch.wrenches(target)
        return target

    def contact_forces(self) -> NDArray[Any]:
        """What all contacts together do to the joints now, (N, nv) [N, N m]: Jᵀ times their wrenches, as in a step."""
        out = np.empty((self.num_envs, self.model.nv), self.dtype)
        self._batch.contact_forces(out)
        return out

    def mass_matrix(self) -> NDArray[Any]:
        """Joint-space mass matrices M(q), (N, nv, nv)."""
        out = np.empty((self.num_envs, self.model.nv, self.model.nv), self.dtype)
        self._batch.mass_matrix(out)
        return out

    def bias(self) -> NDArray[Any]:
        """Coriolis, centrifugal and gravity forces C(q, v), (N, nv)."""
        out = np.empty((self.num_envs, self.model.nv), self.dtype)
        self._batch.bias(out)
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
        out: Trajectory | None = None,
    ) -> Trajectory:
        """Steps under controls u (steps, N, nu), from the given state or the present one, which is not changed.

        Markers are read after the steps named in `read_after` (0 = the start). `out` is an earlier trajectory of as
        many steps and readings, whose arrays are overwritten: fresh memory for many readings takes longer than they
        do. Raises UsageError on wrong shapes and on controls that are not finite.
        """
        controls = np.ascontiguousarray(u, dtype=self.dtype)
        if controls.ndim != 3 or controls.shape[1:] != (self.num_envs, self.model.nu):
            raise UsageError(f"u must have shape (steps, {self.num_envs}, {self.model.nu}), got {controls.shape}")
        steps, n = controls.shape[0], self.num_envs
        if out is not None and (out.u.shape != controls.shape or len(out.read_after) != len(read_after)):
            raise UsageError(
                f"out must be a trajectory of u {controls.shape} and {len(read_after)} readings, "
                f"got {out.u.shape} and {len(out.read_after)}"
            )

        def along_time(name: str, start: ArrayLike | None) -> NDArray[Any]:
            own = getattr(self, name)
            if out is None:  # of anchors only those that are set will be written
                array: NDArray[Any] = np.zeros((steps + 1, *own.shape), own.dtype)
            else:
                array = getattr(out, name)
            array[0] = own if start is None else start
            return array

        reads = np.asarray(read_after, dtype=np.int32)
        readings = (len(reads), n, self.model.markers, 3)
        result = Trajectory(
            q=along_time("q", q),
            v=along_time("v", v),
            anchors=along_time("anchors", anchors),
            anchored=along_time("anchored", anchored),
            history=along_time("history", history),
            u=controls,
            tactile=np.empty(readings, self.dtype) if out is None else out.tactile,
            read_after=reads,
            halvings=np.zeros((steps, n), np.int8),
            status=np.zeros(n, np.int32),
        )
        for name, start in (("q", result.q[0]), ("v", result.v[0])):
            if not np.isfinite(start).all():
                raise UsageError(f"{name}{np.argwhere(~np.isfinite(start))[0].tolist()} is not finite")
        try:
            self._batch.rollout(*self._arguments(result))
        except ValueError as error:
            raise UsageError(str(error)) from None
        return result

    def contact_modes(self, trajectory: Trajectory) -> NDArray[np.uint64]:
        """Signature of the branches that each step took (touching, sliding, clipped), (steps, N).

        Two runs with equal signatures lie on one smooth piece of the dynamics; markers count where they were read.
        """
        result: NDArray[np.uint64] = self._batch.branches(*self._arguments(trajectory))
        return result

    @staticmethod
    def _arguments(t: Trajectory) -> tuple[NDArray[Any], ...]:
        return (t.u, t.q, t.v, t.anchors, t.anchored, t.history, t.halvings, t.status, t.read_after, t.tactile)

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
        """The reverse pass: gradients with respect to the trajectory's q, v, tactile (shaped as there) in, gradients
        with respect to controls and initial state out, and with `params` by every physical parameter, which costs
        many times the rest. Environments that failed have gradient zero."""

        def shaped(value: ArrayLike | None, like: NDArray[Any]) -> NDArray[Any]:
            if value is None:
                return np.zeros(like.shape, self.dtype)
            return np.ascontiguousarray(np.broadcast_to(np.asarray(value, self.dtype), like.shape))

        gradients = self._batch.rollout_transposed(
            *self._arguments(trajectory),
            shaped(q, trajectory.q),
            shaped(v, trajectory.v),
            shaped(anchors_end, trajectory.anchors[0]),
            shaped(history_end, trajectory.history[0]),
            shaped(tactile, trajectory.tactile),
            params,
        )
        return TrajectoryGradient(*gradients)
