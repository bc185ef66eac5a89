"""World poses of the sites of a scene, and their vector-Jacobian product."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gelflow.errors import UsageError
from gelflow.sim import _core
from gelflow.sim.arguments import checked, number_array

Floats = NDArray[np.float64]


def site_poses(scene: Any, model: _core.Model, params: NDArray[Any], q: ArrayLike) -> Floats:
    """Poses (…, N, sites, 7) at positions q (…, N, nq) with the parameters (N, parameters) of each environment."""
    sites, rows = _sites(scene), _rows(model, params, q)
    poses: Floats = checked(_core.site_poses, model, sites, np.asarray(params, dtype=float), rows)
    return poses.reshape(*np.shape(q)[:-1], len(sites), 7)


def site_poses_vjp(scene: Any, model: _core.Model, params: NDArray[Any], q: ArrayLike, grad_poses: ArrayLike) -> Floats:
    """Gradient with respect to q, like q, from that with respect to the poses; for quaternions the tangent gradient."""
    sites, rows = _sites(scene), _rows(model, params, q)
    grad_rows = np.ascontiguousarray(grad_poses, dtype=float).reshape(len(rows), len(sites), 7)
    grad_q: Floats = checked(_core.site_poses_vjp, model, sites, np.asarray(params, dtype=float), rows, grad_rows)
    return grad_q.reshape(np.shape(q))


def _sites(scene: Any) -> list[_core.SiteDef]:
    sites = getattr(scene, "sites", ())
    if not sites:
        raise UsageError("the scene has no sites; add <site> elements to its model file")
    return [
        _core.SiteDef(name=site.name, body=site.body, pos=site.pose.position, quat=site.pose.quaternion)
        for site in sites
    ]


def _rows(model: _core.Model, params: NDArray[Any], q: ArrayLike) -> Floats:
    """Positions (…, N, nq) as rows of one array."""
    positions = np.ascontiguousarray(number_array("q", q, float))
    if positions.ndim < 2 or positions.shape[-2:] != (len(params), model.nq):
        raise UsageError(f"q must have shape (…, {len(params)}, {model.nq}), got {positions.shape}")
    return positions.reshape(-1, model.nq)
