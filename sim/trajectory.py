"""Recorded rollouts, their gradients, and the condition that stops a rollout on touch."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gelflow.errors import UsageError
from gelflow.sim import _core
from gelflow.sim.arguments import check_type, fill, integer, number_array
from gelflow.sim.reductions import TactileReduction


@dataclass(frozen=True, eq=False)
class TouchStop:
    """Stops an environment of a rollout when its markers report a touch.

    After step `after_step` and every later one, an environment stops where the mean change of the shear along the
    finger (marker x), against the reading after `reference_step` steps, exceeds the threshold at one of its pads. It
    then takes no more steps, and later readings repeat the reading at the stop.
    """

    threshold: ArrayLike  # [N], shape (N,) or (); inf: the environment does not stop, and nothing is evaluated
    reference_step: int = 0  # number of steps before the reference reading
    after_step: int | None = None  # None: reference_step + 1

    def core(self, num_envs: int, steps: int) -> _core.TouchStop:
        """The condition for a rollout. Raises UsageError for a threshold or steps that do not fit it."""
        threshold = number_array("threshold", self.threshold, float)
        if threshold.shape not in ((), (num_envs,)):
            raise UsageError(f"threshold must have shape ({num_envs},) or (), got {threshold.shape}")
        if not (threshold >= 0).all():
            raise UsageError("threshold must be at least 0 N everywhere, and not nan")
        integer("reference_step", self.reference_step)
        after_step = self.reference_step + 1 if self.after_step is None else integer("after_step", self.after_step)
        if not 0 <= self.reference_step < after_step <= steps:
            raise UsageError(
                f"a touch stop needs 0 ≤ reference_step < after_step ≤ {steps} steps of the rollout, "
                f"got {self.reference_step} and {after_step}"
            )
        return _core.TouchStop(
            threshold=np.full(num_envs, threshold), reference_step=self.reference_step, after_step=after_step
        )


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A recorded rollout of N environments. The first axis is time, the second the environment.

    Sizes: nq positions, nv velocities, nu controls, na friction anchors, nh values of the BDF2 history. The state of an
    environment that stopped, failed or rested repeats in all later steps. With `end_only` the states have a single row,
    the end of the rollout.
    """

    q: NDArray[Any]  # (steps + 1, N, nq)
    v: NDArray[Any]  # (steps + 1, N, nv)
    anchors: NDArray[Any]  # (steps + 1, N, na, 3), in the frame of the shape in contact [m]
    anchored: NDArray[np.uint8]  # (steps + 1, N, na), 1 where the anchor is set
    history: NDArray[Any]  # (steps + 1, N, nh): previous step of BDF2, see `Simulator`
    u: NDArray[Any]  # (steps, N, nu)
    tactile: NDArray[Any]  # (readings, N, markers, 3): shear x, shear y, normal [N]; (readings, N, rows) if reduced
    read_after: NDArray[np.int32]  # (readings): number of steps taken before each reading of `tactile`
    halvings: NDArray[np.int8]  # (steps, N): the step was split into 2^halvings substeps
    status: NDArray[np.int32]  # (N): 0, or the reason of failure (`STATUS_MESSAGES`)
    active: NDArray[np.uint8]  # (N): 0 where the environment rested
    stopped_at: NDArray[np.int32]  # (N): number of steps before the touch stop; -1 without a stop
    reduction: TactileReduction | None = None  # of the readings

    def core(self) -> _core.Trajectory:
        """The same arrays for the core, without copies."""
        reduction = None if self.reduction is None else self.reduction.core
        return _core.Trajectory(**{**vars(self), "reduction": reduction})

    def check_reusable(self, u_shape: tuple[int, ...], rows: int, tactile_shape: tuple[int, ...]) -> None:
        """Raises UsageError unless the arrays can hold another rollout with these shapes, and `rows` states."""
        if self.u.shape != u_shape or len(self.read_after) != tactile_shape[0]:
            raise UsageError(
                f"out must be a trajectory with u of shape {u_shape} and {tactile_shape[0]} tactile readings, "
                f"got {self.u.shape} and {len(self.read_after)}"
            )
        if len(self.q) != rows:
            raise UsageError(f"out must have {rows} states (see end_only), got {len(self.q)}")
        if self.tactile.shape != tactile_shape:
            raise UsageError(
                f"out must have tactile readings of shape {tactile_shape} (see reduction), got {self.tactile.shape}"
            )

    def reused(self, name: str, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        """An array of the states, for another rollout. Raises UsageError when it has another shape or precision."""
        array: NDArray[Any] = getattr(self, name)
        if array.shape != shape or array.dtype != dtype:
            expected = f"{np.dtype(dtype)} {shape}"
            raise UsageError(f"out is of another model: its {name} is {array.dtype} {array.shape}, not {expected}")
        return array


def check_complete(trajectory: Trajectory) -> None:
    """Raises UsageError unless `trajectory` is a Trajectory with the states of all steps."""
    check_type("trajectory", trajectory, Trajectory, "a Trajectory")
    if len(trajectory.q) <= len(trajectory.u):
        raise UsageError("the trajectory has its last state only; repeat the rollout without end_only")


def state_rows(
    name: str, start: ArrayLike | None, present: NDArray[Any], rows: int, out: Trajectory | None
) -> NDArray[Any]:
    """A part of the state for a rollout, (rows, *shape of `present`): a new array or that of `out`.

    The first row is the initial value: `start`, or without it the present one.
    """
    shape = (rows, *present.shape)
    array = np.zeros(shape, present.dtype) if out is None else out.reused(name, shape, present.dtype)
    fill(name, array[0], present if start is None else start)  # before: it may be the end of `out`
    if out is not None and name == "anchors":
        array[1:] = 0  # the core writes only the anchors that are set
    return array


@dataclass(frozen=True, eq=False)
class TrajectoryGradient:
    """Gradient of a scalar with respect to the inputs of a rollout; for quaternions the tangent gradient."""

    u: NDArray[Any]  # (steps, N, nu)
    q: NDArray[Any]  # (N, nq)
    v: NDArray[Any]  # (N, nv)
    anchors: NDArray[Any]  # (N, na, 3)
    history: NDArray[Any]  # (N, nh)
    params: NDArray[np.float64]  # (N, parameters), in the order of `Model.param_names`; (N, 0) unless requested
