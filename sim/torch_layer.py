"""Differentiable PyTorch functions for a step and for a rollout, with exact gradients (eq. 18 of the paper).

Tensors are on the CPU and have the simulator's precision. The state is an explicit argument; the simulator's own state
is not changed. The gradient of a quaternion is its tangent gradient, mapped to four components. Physical parameters can
be passed by name as tensors; their gradient is computed only when a tensor requires it. Derivatives are first ones, by
`backward` and `torch.autograd.grad`; `torch.func` and batched gradients are not supported.

Paper: Xu et al., Efficient Tactile Simulation with Differentiability for Robotic Manipulation, CoRL 2022.
"""

import threading
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch.autograd.function import once_differentiable

from gelflow.errors import UsageError
from gelflow.sim.arguments import check_type
from gelflow.sim.reductions import TactileReduction
from gelflow.sim.simulator import Simulator
from gelflow.sim.site_poses import site_poses, site_poses_vjp
from gelflow.sim.trajectory import TouchStop, Trajectory


@dataclass(frozen=True, eq=False)
class TorchState:
    """State of all environments; see the attributes of `Simulator`."""

    q: torch.Tensor  # (N, nq)
    v: torch.Tensor  # (N, nv)
    anchors: torch.Tensor  # (N, na, 3) [m]; empty under the viscous law
    anchored: torch.Tensor  # (N, na) uint8; not differentiable
    history: torch.Tensor  # (N, nh); empty under BDF1

    def detach(self) -> "TorchState":
        """The same state without gradient: the start of the next window of truncated back-propagation."""
        return TorchState(
            self.q.detach(), self.v.detach(), self.anchors.detach(), self.anchored.detach(), self.history.detach()
        )


@dataclass(frozen=True, eq=False)
class TorchRollout:
    """Result of `torch_rollout`.

    `ok` (N) is False for failed environments, whose gradient is zero. `stopped_at` (N) is the number of steps before
    the touch stop, -1 without a stop.
    """

    q: torch.Tensor  # (steps + 1, N, nq)
    v: torch.Tensor  # (steps + 1, N, nv)
    tactile: torch.Tensor  # (readings, N, markers, 3) [N], or (readings, N, rows) with a reduction
    end: TorchState
    ok: torch.Tensor
    stopped_at: torch.Tensor


def torch_state(sim: Simulator) -> TorchState:
    """The present state of the simulator, copied to tensors."""
    check_type("sim", sim, Simulator, "a Simulator")
    arrays = (sim.q, sim.v, sim.anchors, sim.anchored, sim.history)
    return TorchState(*(torch.from_numpy(np.array(array)) for array in arrays))


def torch_rollout(
    sim: Simulator,
    state: TorchState,
    u: torch.Tensor,
    *,
    read_after: Sequence[int] = (),
    reduction: TactileReduction | None = None,
    active: ArrayLike | None = None,
    stop: TouchStop | None = None,
    params: Mapping[str, torch.Tensor] | None = None,
) -> TorchRollout:
    """Take steps with controls u (steps, N, nu) from `state`.

    Marker forces are evaluated after the numbers of steps in `read_after`. `reduction`, `active` and `stop` are those
    of `Simulator.rollout`. `params` replaces parameters of the simulator by name; each has shape (N,), or () for all
    environments.

    Differentiable with respect to u, state.q, state.v, state.anchors, state.history and params; an environment that
    stopped is differentiated as the steps that it took. Raises UsageError for wrong shapes, a precision other than the
    simulator's, unknown parameters, and values that are not finite.
    """
    check_type("sim", sim, Simulator, "a Simulator")
    check_type("state", state, TorchState, "a TorchState (see torch_state)")
    check_type("state.anchored", state.anchored, torch.Tensor, "a tensor")
    check_type("params", params, (Mapping, type(None)), "a mapping of parameter names to tensors")
    expected = torch.float64 if sim.dtype is np.float64 else torch.float32
    named = {"u": u, "q": state.q, "v": state.v, "anchors": state.anchors, "history": state.history, **(params or {})}
    for name, tensor in named.items():
        if not isinstance(tensor, torch.Tensor):
            raise UsageError(f"{name} must be a tensor of {expected}, got {type(tensor).__name__}")
        _check_tensor(name, tensor, expected)
    _check_tensor("state.anchored", state.anchored, torch.uint8)
    numbers = None if params is None else _all_params(sim, params)
    starts = (tensor.resolve_neg() for tensor in (u, state.q, state.v, state.anchors, state.history))
    inputs = (*starts, numbers, state.anchored)
    options = {"read_after": read_after, "reduction": reduction, "active": active, "stop": stop}
    outputs = _Rollout.apply(*inputs, sim, options)  # type: ignore[no-untyped-call]
    q, v, tactile, anchors, history, anchored, ok, stopped_at = outputs
    return TorchRollout(q, v, tactile, TorchState(q[-1], v[-1], anchors, anchored, history), ok, stopped_at)


def _check_tensor(name: str, tensor: torch.Tensor, *dtypes: torch.dtype) -> None:
    """Raise UsageError for a tensor of another type, a sparse one, or one that is not on the CPU."""
    if tensor.dtype not in dtypes or tensor.device.type != "cpu" or tensor.layout != torch.strided:
        wanted, layout = " or ".join(map(str, dtypes)), "" if tensor.layout == torch.strided else "sparse "
        raise UsageError(f"{name} must be a CPU tensor of {wanted}, got {layout}{tensor.dtype} on {tensor.device}")


def _all_params(sim: Simulator, params: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Parameters of the simulator with replacements, (N, parameters)."""
    numbers = torch.from_numpy(sim.params.copy())
    for name, values in params.items():
        sim.param(name)  # raises for an unknown name
        if values.shape not in ((), (sim.num_envs,)):
            raise UsageError(f"{name} must have shape ({sim.num_envs},) or (), got {tuple(values.shape)}")
        if not torch.isfinite(values).all():
            raise UsageError(f"{name} is not finite")
        numbers[:, sim.param_index[name]] = values
    return numbers


def torch_step(
    sim: Simulator, state: TorchState, u: torch.Tensor, *, params: Mapping[str, torch.Tensor] | None = None
) -> tuple[TorchState, torch.Tensor]:
    """One step with controls u (N, nu): the new state and its marker forces, (N, markers, 3) [N]."""
    check_type("sim", sim, Simulator, "a Simulator")
    check_type("u", u, torch.Tensor, "a tensor")
    result = torch_rollout(sim, state, u[None], read_after=(1,) if sim.model.num_markers else (), params=params)
    tactile = result.tactile[0] if sim.model.num_markers else result.q.new_zeros((sim.num_envs, 0, 3))
    return result.end, tactile


def torch_site_poses(sim: Simulator, q: torch.Tensor) -> torch.Tensor:
    """World poses (…, N, sites, 7) of the sites at positions q (…, N, nq), such as `TorchRollout.q`.

    Position [m] and quaternion w x y z, in the order of `Scene.sites`. Differentiable with respect to q; the parameters
    are those of the simulator. Raises UsageError for wrong shapes and for a scene without sites.
    """
    check_type("sim", sim, Simulator, "a Simulator")
    check_type("q", q, torch.Tensor, "a tensor")
    _check_tensor("q", q, torch.float32, torch.float64)
    return _SitePoses.apply(q, sim)  # type: ignore[no-untyped-call,no-any-return]


class _SitePoses(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, q: torch.Tensor, sim: Simulator) -> torch.Tensor:
        ctx.sim, ctx.params, ctx.q = sim, sim.params.copy(), q.detach().numpy().copy()
        return torch.from_numpy(site_poses(sim.scene, sim.model, ctx.params, ctx.q)).to(q.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_poses: torch.Tensor) -> tuple[torch.Tensor, None]:
        grad_q = site_poses_vjp(ctx.sim.scene, ctx.sim.model, ctx.params, ctx.q, grad_poses.numpy())
        return torch.from_numpy(grad_q).to(grad_poses.dtype), None


class _Rollout(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        u: torch.Tensor,
        q: torch.Tensor,
        v: torch.Tensor,
        anchors: torch.Tensor,
        history: torch.Tensor,
        params: torch.Tensor | None,
        anchored: torch.Tensor,
        sim: Simulator,
        options: dict[str, Any],
    ) -> tuple[torch.Tensor, ...]:
        # The reverse pass needs the parameters of the forward pass, even if sim.params changes in between.
        with _temporary_params(sim, None if params is None else params.detach().numpy()) as ctx.params:
            trajectory = sim.rollout(
                u.detach().numpy(),
                q=q.detach().numpy(),
                v=v.detach().numpy(),
                anchors=anchors.detach().numpy(),
                anchored=anchored.numpy(),
                history=history.detach().numpy(),
                **options,
            )
        ctx.sim = sim
        ctx.trajectory = trajectory
        ends = (torch.from_numpy(array[-1].copy()) for array in (trajectory.anchors, trajectory.history))
        set_at_end = torch.from_numpy(trajectory.anchored[-1].copy())
        ok = torch.from_numpy(trajectory.status == 0)
        stopped_at = torch.from_numpy(trajectory.stopped_at.copy())
        ctx.mark_non_differentiable(set_at_end, ok, stopped_at)
        arrays = (trajectory.q, trajectory.v, trajectory.tactile)
        return (*(torch.from_numpy(array.copy()) for array in arrays), *ends, set_at_end, ok, stopped_at)

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any,
        grad_q: torch.Tensor,
        grad_v: torch.Tensor,
        grad_tactile: torch.Tensor,
        grad_anchors: torch.Tensor,
        grad_history: torch.Tensor,
        *_: Any,
    ) -> tuple[torch.Tensor | None, ...]:
        sim: Simulator = ctx.sim
        trajectory: Trajectory = ctx.trajectory
        wanted = ctx.needs_input_grad[5]
        with _temporary_params(sim, ctx.params):
            gradient = sim.rollout_gradient(
                trajectory,
                q=grad_q.numpy(),
                v=grad_v.numpy(),
                tactile=grad_tactile.numpy(),
                anchors_end=grad_anchors.numpy(),
                history_end=grad_history.numpy(),
                params=wanted,
            )
        arrays = (gradient.u, gradient.q, gradient.v, gradient.anchors, gradient.history)
        grad_params = torch.from_numpy(gradient.params.astype(sim.dtype)) if wanted else None
        return (*(torch.from_numpy(array) for array in arrays), grad_params, None, None, None)


_locks: "weakref.WeakKeyDictionary[Simulator, threading.Lock]" = weakref.WeakKeyDictionary()


@contextmanager
def _temporary_params(sim: Simulator, params: NDArray[Any] | None) -> Iterator[NDArray[Any]]:
    """Replace the parameters of the simulator within a context, None: keep them; yields a copy of those in the context.

    Raises UsageError while another thread is in such a context.
    """
    lock = _locks.setdefault(sim, threading.Lock())
    if not lock.acquire(blocking=False):
        raise UsageError("the simulator is busy with a call of another thread; give each thread its own simulator")
    try:
        kept = sim.params.copy()
        if params is None:
            yield kept
            return
        sim.params[:] = params
        try:
            yield params
        finally:
            sim.params[:] = kept
    finally:
        lock.release()
