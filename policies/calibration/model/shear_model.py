"""Marker forces of recorded descents as a function of physical parameters, with exact derivatives.

A descent is simulated as in `InsertionAttempts`: the part comes to rest in the closed gripper, far above the hole, and
is then lowered from a pose in the hole frame. Values of many descents are computed in batches. Derivatives come from
forward-mode differentiation of the core (dual numbers); the grasp at rest, which all descents with equal parameters
share, is differentiated once.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import SimulationError, UsageError
from gelflow.geometry import apply_planar, rotated, rotation_matrices, turned_about_z
from gelflow.policies.calibration.model.fidelity import EXACT, Fidelity
from gelflow.sim import _core
from gelflow.sim.simulator import STATUS_MESSAGES, Simulator
from gelflow.sim.tasks.gripper.pads import NOMINAL_PAD_VALUES
from gelflow.sim.tasks.insertion import SETTLE_TIME, descent_steps, insertion_scene
from gelflow.sim.tasks.insertion_randomization import ARM_JOINTS, simulator_parameters
from gelflow.sim.tasks.parts.grasp import indentation, pad_gaps
from gelflow.sim.tasks.parts.part_scene import hole_parameters
from gelflow.sim.tasks.parts.registry import part_geometry
from gelflow.task import InsertionTask

Array = NDArray[np.float64]

CONTACT_QUANTITIES = ("pad_kn", "pad_mu", "pad_ks", "marker_kn", "marker_mu", "marker_ks", "hole_kn", "hole_mu")
QUANTITIES = (*CONTACT_QUANTITIES, "arm_stiffness", "grasp_force", "grasp_height")
_WITHOUT_GRASP = ("hole_kn", "hole_mu")  # have no effect on the grasp at rest
POSE = ("x", "y", "yaw", "z")  # directions of the pose of a descent, after `QUANTITIES`
_BATCH = 64  # descents that are simulated at once
_PAST_RIM = 0.5e-3  # depth below the rim up to which all steps of a descent are simulated [m]
_KEPT = 8  # numbers of descents for which a simulator is kept
_FINGERS = (("finger_left", "pad_left"), ("finger_right", "pad_right"))


@dataclass(frozen=True)
class Descents:
    """Gripper poses of n descents in the hole frame, and their depths."""

    pose: Array  # x [m], y [m], yaw [rad], shape (n, 3)
    z: Array  # height of the lower face at the start above the task's start height [m], shape (n,)
    depth: Array  # of the gripper's target at the reading, below the start [m], shape (n,)

    def __getitem__(self, rows: NDArray[np.int64]) -> "Descents":
        return Descents(self.pose[rows], self.z[rows], self.depth[rows])


@dataclass(frozen=True)
class _Grasp:
    """The part at rest in the gripper, one row for each descent, or derivatives: then q has nv entries."""

    q: Array
    anchors: Array
    u: Array
    params: Array
    shear: Array  # (n, markers, 2)


class ShearModel:
    """Change of the shear forces of the markers from the grasp at rest to the end of a descent.

    Parameters
    ----------
    task: task of the descents
    settle: time at the end of a descent until the reading [s]; 0 for the training environment, which reads in motion
    threads: of the simulator
    fidelity: of the simulation; an iteration limit can be lifted, see `lift_iteration_limit`
    """

    def __init__(
        self, task: InsertionTask, *, settle: float = 0.0, threads: int | None = None, fidelity: Fidelity = EXACT
    ) -> None:
        self.task = task
        self.scene = insertion_scene(task, preset=fidelity.preset)
        if fidelity.tolerance is not None:
            self.scene = dataclasses.replace(self.scene, tolerance=fidelity.tolerance)
        self._without_limit = self.scene
        if fidelity.iteration_limit is not None:
            self.scene = dataclasses.replace(self.scene, max_step_iterations=fidelity.iteration_limit)
        self._fidelity = fidelity
        self._threads = threads
        step = self.scene.step
        self._settle_steps, self._hold_steps = round(SETTLE_TIME / step), round(settle / step)
        self.step_depth = task.descent / descent_steps(task, self.scene)  # of one step of a descent [m]
        self._geometry = part_geometry(task.part)
        self._clear_height = max(0.1, task.part.depth + task.part.size[2])
        self._part_q = self.scene.q("part").start
        self._arm_q = [self.scene.q(name).start for name in ARM_JOINTS]
        self._arm_u = [self.scene.u(name) for name in ARM_JOINTS]
        self._sims: dict[int, Simulator] = {}

    def lift_iteration_limit(self) -> bool:
        """Simulate descents from now on that need many iterations; returns whether they failed before."""
        if self.scene is self._without_limit:
            return False
        self.scene = self._without_limit
        self._sims.clear()
        return True

    def _sim(self, count: int) -> Simulator:
        if count not in self._sims:
            if len(self._sims) >= _KEPT:
                self._sims.clear()
            self._sims[count] = Simulator(self.scene, num_envs=count, threads=self._threads)
        return self._sims[count]

    # Values

    def shear(self, values: Mapping[str, Array], descents: Descents) -> tuple[Array, NDArray[np.bool_]]:
        """Change of the shear forces (n, markers, 2) [N], and whether the simulation succeeded (n,).

        `values` has the `QUANTITIES`, shape (n,) each.
        """
        n = len(descents.depth)
        change, ok = np.zeros((n, self.scene.num_markers, 2)), np.zeros(n, np.bool_)
        # Descents of a similar length together: a batch has as many steps as its longest.
        in_order = np.argsort(descents.depth, kind="stable")
        for rows in np.split(in_order, range(_BATCH, n, _BATCH)):
            change[rows], ok[rows] = self._shear({name: value[rows] for name, value in values.items()}, descents[rows])
        return change, ok

    def _shear(self, values: Mapping[str, Array], descents: Descents) -> tuple[Array, NDArray[np.bool_]]:
        grasp, anchored, held = self._grasps(values)
        q, u = self._start(grasp, descents)
        sim = self._sim(len(descents.depth))
        sim.params[:] = grasp.params
        sim.reset()
        sim.q[:], sim.anchors[:], sim.anchored[:] = q, grasp.anchors, anchored
        z = self._arm_u[2]
        start = u[:, z].copy()
        for depth in self._depths(descents.depth):
            u[:, z] = start - depth
            sim.step(u)
        sim.step(u, self._hold_steps)
        change = sim.tactile()[:, :, :2] - grasp.shear
        ok = (sim.status == 0) & held
        return np.where(ok[:, None, None], change, 0.0), ok

    def _grasps(self, values: Mapping[str, Array]) -> tuple[_Grasp, NDArray[np.uint8], NDArray[np.bool_]]:
        """`_grasp` for each row of `values`; equal rows are simulated once."""
        rows = np.stack([values[name] for name in QUANTITIES], axis=1)
        different, of_row = np.unique(rows, axis=0, return_inverse=True)
        sim = self._sim(len(different))
        grasp, anchored, held = self._grasp(sim, dict(zip(QUANTITIES, different.T, strict=True)))
        return _Grasp(*(array[of_row] for array in vars(grasp).values())), anchored[of_row], held[of_row]

    def _depths(self, depth: Array) -> Array:
        """Depths below the start after each step of descents (n,), shape (steps, n).

        Descents end at the same time; before a descent begins, the gripper is at rest.
        """
        counts = np.maximum(1, np.round(depth / self.step_depth)).astype(np.int64)
        to_rim = self.task.start_height - self.task.rim_height
        near_rim = int((to_rim + _PAST_RIM) / self.step_depth)
        taken = [self._fidelity.simulated_steps(count, near_rim) for count in counts]
        result = np.zeros((max(map(len, taken)), len(depth)))
        for i, steps in enumerate(taken):
            result[len(result) - len(steps) :, i] = depth[i] * steps / counts[i]
        return result

    def _params(self, sim: Simulator, values: Mapping[str, Array]) -> Array:
        """Parameters of the simulator, (n, parameters)."""
        params = np.repeat(self._default[None], len(values["pad_kn"]), axis=0)
        for name, column in self._columns(sim, values).items():
            params[:, name] = column
        return params

    @cached_property
    def _default(self) -> Array:
        """Parameters of the scene, with a right jaw that is force controlled."""
        sim = Simulator(self.scene, threads=1)
        for name in ("hold_right.kp", "hold_right.kd"):
            sim.param(name)[:] = 0.0
        return np.array(sim.params[0])

    def _columns(self, sim: Simulator, values: Mapping[str, Array]) -> dict[int, Array]:
        """Values by column of the parameters; linear in `values`, except for the damping of the markers."""
        damping = np.full_like(values["pad_kn"], NOMINAL_PAD_VALUES["marker_kd"])
        named = simulator_parameters({"marker_kd": damping, **values}, elastic=True)
        return {sim.param_index[name]: column for name, column in hole_parameters(self.scene, named).items()}

    def _closed(self, values: Mapping[str, Array], params: Array, sim: Simulator) -> tuple[Array, Array]:
        """Initial positions and controls of the closing gripper, far above the hole."""
        n, scene, height = len(params), self.scene, values["grasp_height"]
        q, u = np.tile(scene.q0, (n, 1)), np.zeros((n, scene.nu))
        q[:, self._part_q + 2] = self._clear_height
        q[:, self._arm_q[2]] = self._clear_height + height
        for finger, pad in _FINGERS:
            gaps = pad_gaps(scene, self._geometry, pad, height)
            q[:, scene.q(finger)] += indentation(gaps, values["grasp_force"], values["pad_kn"])[:, None]
            u[:, scene.u(finger)] = values["grasp_force"]
        u[:, scene.u("hold_left")] = q[:, scene.q("finger_left").start]
        u[:, self._arm_u] = q[:, self._arm_q]
        u[:, self._arm_u[2]] += self._weight(params, sim) / values["arm_stiffness"]
        return q, u

    def _weight(self, params: Array, sim: Simulator) -> Array:
        masses = [sim.param_index[f"{body.name}.mass"] for body in self.scene.bodies]
        return np.asarray(-float(self.scene.gravity[2]) * params[:, masses].sum(1))

    def _grasp(
        self, sim: Simulator, values: Mapping[str, Array]
    ) -> tuple[_Grasp, NDArray[np.uint8], NDArray[np.bool_]]:
        """The part at rest in the gripper, which friction anchors are set, and whether the simulation succeeded."""
        sim.params[:] = params = self._params(sim, values)
        sim.reset()
        q, u = self._closed(values, params, sim)
        sim.q[:] = q
        sim.step(u, self._settle_steps)
        shear = np.array(sim.tactile()[:, :, :2])
        dropped = np.abs(sim.q[:, self._part_q + 2] - self._clear_height) > 5e-3
        grasp = _Grasp(sim.q.copy(), sim.anchors.copy(), u, params, shear)
        return grasp, sim.anchored.copy(), (sim.status == 0) & ~dropped

    def _start(self, grasp: _Grasp, descents: Descents) -> tuple[Array, Array]:
        """Positions and controls of the grasps at the starts of the descents."""
        q, u, at = grasp.q.copy(), grasp.u.copy(), self._part_q
        part = grasp.q[:, at : at + 7]
        lift = self.task.start_height + self.task.part.size[2] / 2 + descents.z - part[:, 2]
        x, y, yaw = descents.pose.T
        q[:, self._arm_q] = np.column_stack([x, y, q[:, self._arm_q[2]] + lift, yaw])
        q[:, at : at + 2] = apply_planar(descents.pose, part[:, :2])
        q[:, at + 2] += lift
        q[:, at + 3 : at + 7] = turned_about_z(part[:, 3:], yaw)
        u[:, self._arm_u] = np.column_stack([x, y, u[:, self._arm_u[2]] + lift, yaw])
        return q, u

    # Derivatives

    def derivatives(
        self, values: Mapping[str, float], descents: Descents, wanted: Sequence[str]
    ) -> tuple[Array, Array]:
        """Change of the shear forces (n, markers, 2) [N] and its derivatives (n, directions, markers, 2).

        All descents share `values`. Directions are those of `wanted`, names of `QUANTITIES` [per unit] or `POSE` [per m
        or rad]. Raises SimulationError when a step fails.
        """
        sim = self._sim(1)
        rows = {name: np.array([value]) for name, value in values.items()}
        params = self._params(sim, rows)
        q, u = self._closed(rows, params, sim)
        anchored = np.zeros(sim.anchors.shape[1], np.uint8)
        zero = self._zero(sim)
        start = (params[0], q[0], np.zeros_like(zero.anchors), np.repeat(u, self._settle_steps, 0), anchored)
        if not wanted:
            raise UsageError("derivatives need at least one direction")
        closing = {
            name: self._closing(sim, name, rows, params)
            for name in wanted
            if name in QUANTITIES and name not in _WITHOUT_GRASP
        }
        end = self._dual(sim, start, list(closing.values()) or [zero])
        grasp = _state(end.end, u[0], params[0])
        settled = dict.fromkeys(wanted, zero)
        for (name, tangent), derivative in zip(closing.items(), end.derivatives, strict=False):
            settled[name] = _state(derivative, tangent.u, tangent.params)
        for name in wanted:
            if name in QUANTITIES:
                settled[name] = _with_params(settled[name], self._param_direction(sim, name, params[0], values))
        results = [self._descend(sim, grasp, end.anchored, settled, descents[np.array([i])])
                   for i in range(len(descents.depth))]  # fmt: skip
        return np.stack([r[0] for r in results]), np.stack([r[1] for r in results])

    def _descend(
        self,
        sim: Simulator,
        grasp: _Grasp,
        anchored: NDArray[np.uint8],
        settled: Mapping[str, _Grasp],
        descent: Descents,
    ) -> tuple[Array, Array]:
        """Value of one descent, and its derivatives along the directions that `settled` names."""
        one = _Grasp(*(np.asarray(values)[None] for values in vars(grasp).values()))
        q, controls = self._start(one, descent)
        depths, z = self._depths(descent.depth)[:, 0], self._arm_u[2]
        u = np.repeat(controls, len(depths) + self._hold_steps, axis=0)
        u[:, z] -= np.append(depths, np.repeat(descent.depth, self._hold_steps))
        start = (grasp.params, q[0], grasp.anchors, u, anchored)
        tangents = [self._tangent_at_start(sim, name, tangent, q[0], descent) for name, tangent in settled.items()]
        end = self._dual(sim, start, tangents)
        slopes = np.stack([_shear(derivative.tactile) for derivative in end.derivatives])
        return _shear(end.end.tactile) - grasp.shear, slopes - np.stack([one.shear for one in settled.values()])

    def _zero(self, sim: Simulator) -> _Grasp:
        markers = (self.scene.num_markers, 2)
        na = sim.anchors.shape[1:]
        return _Grasp(
            np.zeros(sim.model.nv),
            np.zeros(na),
            np.zeros(self.scene.nu),
            np.zeros(sim.params.shape[1]),
            np.zeros(markers),
        )

    def _param_direction(self, sim: Simulator, name: str, params: Array, values: Mapping[str, float]) -> Array:
        """Derivative of the simulator's parameters with respect to a quantity."""
        direction = np.zeros_like(params)
        if name in CONTACT_QUANTITIES or name == "arm_stiffness":
            unit = {key: np.array([float(key == name)]) for key in values}
            for column, value in self._columns(sim, {**unit, "marker_kd": np.zeros(1)}).items():
                direction[column] = value[0]
        return direction

    def _closing(self, sim: Simulator, name: str, values: Mapping[str, Array], params: Array) -> _Grasp:
        """Derivative of the closing gripper's start with respect to a quantity."""
        zero, scene = self._zero(sim), self.scene
        number = {key: float(value[0]) for key, value in values.items()}
        direction = self._param_direction(sim, name, params[0], number)
        q, u = zero.q.copy(), zero.u.copy()
        if name == "grasp_height":
            q[self._arm_q[2]] = u[self._arm_u[2]] = 1.0
        if name == "arm_stiffness":
            u[self._arm_u[2]] = -float(self._weight(params, sim)[0]) / number["arm_stiffness"] ** 2
        force, kn = number["grasp_force"], number["pad_kn"]
        for finger, pad in _FINGERS:
            gaps = pad_gaps(scene, self._geometry, pad, values["grasp_height"])
            inverse = _points_in_contact(gaps[0], force, kn)
            # δ = (F / kn + Σ gaps) / k with k points in contact; the first position equals the first velocity here.
            change = {"grasp_force": inverse / kn, "pad_kn": -inverse * force / kn**2}.get(name, 0.0)
            q[scene.q(finger).start] = change
            if finger == "finger_left":
                u[scene.u("hold_left")] = change
            u[scene.u(finger)] = float(name == "grasp_force")
        return _Grasp(q, zero.anchors, u, direction, zero.shear)

    def _tangent_at_start(self, sim: Simulator, name: str, settled: _Grasp, start: Array, descent: Descents) -> _Grasp:
        """Derivative of the start of a descent, from that of the grasp at rest and of the pose."""
        q, u, at = settled.q.copy(), settled.u.copy(), sim.joint_v("part")
        x, y, yaw = descent.pose[0]
        lift = -q[at + 2]
        q[at : at + 2], q[at + 2] = rotated(q[at : at + 2], yaw), 0.0
        q[self._arm_q] = 0.0, 0.0, q[self._arm_q[2]] + lift, 0.0
        u[self._arm_u] = 0.0, 0.0, u[self._arm_u[2]] + lift, 0.0
        if name in POSE:
            axis = ARM_JOINTS.index(f"arm_{name}")
            q[self._arm_q[axis]] = u[self._arm_u[axis]] = 1.0
            if name == "yaw":
                offset = start[self._part_q : self._part_q + 2] - (x, y)
                q[at : at + 2] += -offset[1], offset[0]
                # The rotation of a free joint is a tangent vector in the frame of its body.
                q[at + 3 : at + 6] += rotation_matrices(start[None, self._part_q + 3 : self._part_q + 7])[0][2]
            else:
                q[at + axis] += 1.0
        return _Grasp(q, settled.anchors, u, settled.params, settled.shear)

    def _dual(
        self, sim: Simulator, start: tuple[Array, Array, Array, Array, NDArray[np.uint8]], tangents: Sequence[_Grasp]
    ) -> _core.DirectionalRollout:
        params, q, anchors, u, anchored = start
        v, history = np.zeros(sim.model.nv), np.zeros(sim.history.shape[1])
        result = _core.directional_rollout(
            sim.model,
            _core.RolloutInput(params=params, q=q, v=v, anchors=anchors, history=history, u=u, anchored=anchored),
            [
                _core.RolloutInput(
                    params=tangent.params,
                    q=tangent.q,
                    v=v,
                    anchors=tangent.anchors,
                    history=history,
                    u=np.repeat(tangent.u[None], len(u), axis=0),
                )
                for tangent in tangents
            ],
        )
        if result.status:
            raise SimulationError(f"a recorded descent cannot be simulated: {STATUS_MESSAGES[result.status]}")
        return result


def _state(end: _core.RolloutEnd, u: Array, params: Array) -> _Grasp:
    return _Grasp(np.array(end.q), np.array(end.anchors).reshape(-1, 3), u, params, _shear(end.tactile))


def _with_params(grasp: _Grasp, params: Array) -> _Grasp:
    return _Grasp(grasp.q, grasp.anchors, grasp.u, params, grasp.shear)


def _shear(tactile: Array) -> Array:
    return np.array(tactile).reshape(-1, 3)[:, :2]


def _points_in_contact(gaps: Array, force: float, stiffness: float) -> float:
    """1 / number of the springs in contact, see `indentation`."""
    count = np.arange(1, len(gaps) + 1)
    return 1.0 / float(count[np.argmin((force + stiffness * np.cumsum(gaps)) / (stiffness * count))])
