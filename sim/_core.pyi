"""Types of the C++ core. Units are SI, quaternions w x y z; N is the number of environments."""

from collections.abc import Sequence
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

class BodyDef:
    """A moving body. `inertia` is about the centre of mass: xx, yy, zz, xy, xz, yz [kg m²]."""

    name: str
    parent: int  # index of a body; -1: the world
    @property
    def pos(self) -> Floats: ...  # (3,), in the parent's frame at q = 0 [m]
    @pos.setter
    def pos(self, value: ArrayLike) -> None: ...
    @property
    def quat(self) -> Floats: ...  # (4,)
    @quat.setter
    def quat(self, value: ArrayLike) -> None: ...
    mass: float  # [kg]
    @property
    def com(self) -> Floats: ...  # (3,), centre of mass in the body frame [m]
    @com.setter
    def com(self, value: ArrayLike) -> None: ...
    @property
    def inertia(self) -> Floats: ...  # (6,)
    @inertia.setter
    def inertia(self, value: ArrayLike) -> None: ...
    gravcomp: float  # share of the weight that a force at com + gravcomp_pos balances
    @property
    def gravcomp_pos(self) -> Floats: ...  # (3,), in the body frame [m]
    @gravcomp_pos.setter
    def gravcomp_pos(self, value: ArrayLike) -> None: ...
    def __init__(
        self,
        *,
        name: str,
        parent: int = -1,
        pos: ArrayLike = ...,
        quat: ArrayLike = ...,
        mass: float,
        com: ArrayLike = ...,
        inertia: ArrayLike,
        gravcomp: float = 0.0,
        gravcomp_pos: ArrayLike = ...,
    ) -> None: ...

class JointDef:
    """A joint of a body. A slide or hinge has an axis, limits and the position `ref` of the body's defined pose."""

    name: str
    body: int
    type: str  # slide, hinge, ball or free
    @property
    def pos(self) -> Floats: ...  # (3,), in the body frame [m]
    @pos.setter
    def pos(self, value: ArrayLike) -> None: ...
    @property
    def axis(self) -> Floats: ...  # (3,), in the body frame
    @axis.setter
    def axis(self, value: ArrayLike) -> None: ...
    ref: float
    damping: float
    armature: float
    stiffness: float
    springref: float
    lower: float
    upper: float
    limit_stiffness: float
    limit_damping: float
    frictionloss: float
    prescribed: bool  # no force changes its velocity
    def __init__(
        self,
        *,
        name: str,
        body: int,
        type: str,
        pos: ArrayLike = ...,
        axis: ArrayLike = ...,
        ref: float = 0.0,
        damping: float = 0.0,
        armature: float = 0.0,
        stiffness: float = 0.0,
        springref: float = 0.0,
        lower: float = ...,
        upper: float = ...,
        limit_stiffness: float = 0.0,
        limit_damping: float = 0.0,
        frictionloss: float = 0.0,
        prescribed: bool = False,
    ) -> None: ...

class DistanceGrid:
    """B-spline coefficients (x, y, z) of a signed distance; cells of edge `spacing` from the corner `origin` [m]."""

    def __init__(self, *, origin: ArrayLike, spacing: float, coefficients: ArrayLike) -> None: ...
    @property
    def origin(self) -> Floats: ...
    @property
    def spacing(self) -> float: ...
    @property
    def coefficients(self) -> NDArray[np.float32]: ...

class ShapeDef:
    """A shape on a body. `size`: half sizes or half axes; radius, then half length along z; scale of a grid."""

    name: str
    body: int  # -1: the world
    kind: str  # plane, sphere, box, cylinder, capsule, ellipsoid or grid
    @property
    def pos(self) -> Floats: ...
    @pos.setter
    def pos(self, value: ArrayLike) -> None: ...
    @property
    def quat(self) -> Floats: ...
    @quat.setter
    def quat(self, value: ArrayLike) -> None: ...
    @property
    def size(self) -> Floats: ...  # (3,) [m]
    @size.setter
    def size(self, value: ArrayLike) -> None: ...
    rounding: float  # radius of the edges of a box or cylinder [m]
    grid: DistanceGrid | None
    def __init__(
        self,
        *,
        name: str,
        body: int = -1,
        kind: str,
        pos: ArrayLike = ...,
        quat: ArrayLike = ...,
        size: ArrayLike = ...,
        rounding: float = 0.0,
        grid: DistanceGrid | None = None,
    ) -> None: ...

class PointsDef:
    """Contact points of a body; with a `radius` one point, the centre of a sphere that touches planes."""

    name: str
    body: int
    @property
    def points(self) -> Floats: ...  # (n, 3), in the set's frame [m]
    @points.setter
    def points(self, value: ArrayLike) -> None: ...
    weights: list[float] | None  # None: 1 each
    radius: float  # [m]
    @property
    def pos(self) -> Floats: ...
    @pos.setter
    def pos(self, value: ArrayLike) -> None: ...
    @property
    def quat(self) -> Floats: ...
    @quat.setter
    def quat(self, value: ArrayLike) -> None: ...
    @property
    def areas(self) -> Floats | None: ...  # (n, 3), where weights are areas: the share across each axis [m²]
    @areas.setter
    def areas(self, value: ArrayLike | None) -> None: ...
    def __init__(
        self,
        *,
        name: str,
        body: int = -1,
        points: ArrayLike,
        weights: ArrayLike | None = None,
        radius: float = 0.0,
        pos: ArrayLike = ...,
        quat: ArrayLike = ...,
        areas: ArrayLike | None = None,
    ) -> None: ...

class ContactDef:
    """Contact of a point set with a shape, by their indices. kn, kt, mu, kd, ks: see docs/reference/physics.md."""

    name: str
    points: int
    shape: int
    law: str  # viscous or elastic
    damping: str  # hunt-crossley (k_d scaled by depth) or linear
    kn: float
    kt: float
    mu: float
    kd: float
    ks: float
    def __init__(
        self,
        *,
        name: str,
        points: int,
        shape: int,
        law: str = "viscous",
        damping: str = "hunt-crossley",
        kn: float,
        kt: float,
        mu: float,
        kd: float,
        ks: float = 0.0,
    ) -> None: ...

class PadDef:
    """A tactile pad. `axes`: columns x, y, z of each marker; those of the pad's frame by default."""

    name: str
    body: int
    @property
    def positions(self) -> Floats: ...  # (n, 3), of the markers in the pad's frame [m]
    @positions.setter
    def positions(self, value: ArrayLike) -> None: ...
    @property
    def axes(self) -> Floats | None: ...  # (n, 3, 3)
    @axes.setter
    def axes(self, value: ArrayLike | None) -> None: ...
    shapes: list[int]  # that the pad touches
    law: str
    kn: float
    kt: float
    mu: float
    kd: float
    ks: float
    weights: list[float] | None  # None: 1 each
    @property
    def pos(self) -> Floats: ...
    @pos.setter
    def pos(self, value: ArrayLike) -> None: ...
    @property
    def quat(self) -> Floats: ...
    @quat.setter
    def quat(self, value: ArrayLike) -> None: ...
    collides: bool  # the markers are contact points too
    def __init__(
        self,
        *,
        name: str,
        body: int = -1,
        positions: ArrayLike,
        axes: ArrayLike | None = None,
        shapes: list[int],
        law: str = "viscous",
        kn: float,
        kt: float,
        mu: float,
        kd: float,
        ks: float = 0.0,
        weights: ArrayLike | None = None,
        pos: ArrayLike = ...,
        quat: ArrayLike = ...,
        collides: bool = False,
    ) -> None: ...

class TendonDef:
    """A fixed tendon: its length is the sum of coefficient × position over slides and hinges."""

    name: str
    joints: list[int]
    coefficients: list[float]  # one per joint
    damping: float
    armature: float
    stiffness: float
    springref: float
    lower: float
    upper: float
    limit_stiffness: float
    limit_damping: float
    frictionloss: float
    def __init__(
        self,
        *,
        name: str,
        joints: Sequence[int],
        coefficients: Sequence[float],
        damping: float = 0.0,
        armature: float = 0.0,
        stiffness: float = 0.0,
        springref: float = 0.0,
        lower: float = ...,
        upper: float = ...,
        limit_stiffness: float = 0.0,
        limit_damping: float = 0.0,
        frictionloss: float = 0.0,
    ) -> None: ...

class CouplingDef:
    """A slide or hinge whose position is a polynomial of that of another one, or fixed (leader -1).

    Up to degree 1 the joint is eliminated from the unknowns, above a damped spring keeps the coupling.
    """

    name: str
    joint: int
    leader: int
    coefficients: list[float]  # of the powers 0, 1, …
    stiffness: float
    damping: float
    def __init__(
        self,
        *,
        name: str,
        joint: int,
        leader: int = -1,
        coefficients: Sequence[float],
        stiffness: float = 0.0,
        damping: float = 0.0,
    ) -> None: ...

class LoopClosureDef:
    """Two points of two bodies that coincide; of a weld also the orientations. Damped springs keep them."""

    name: str
    first: int  # index of a body; -1: the world
    second: int
    weld: bool
    @property
    def quat(self) -> Floats: ...  # (4,), of a weld: the first body in the frame of the second
    @quat.setter
    def quat(self, value: ArrayLike) -> None: ...
    stiffness: float  # [N/m]
    damping: float  # [N s/m]
    turn_stiffness: float  # of a weld [N m/rad]
    turn_damping: float  # of a weld [N m s/rad]
    def __init__(
        self,
        *,
        name: str,
        first: int = -1,
        second: int = -1,
        first_pos: ArrayLike = ...,
        second_pos: ArrayLike = ...,
        weld: bool = False,
        quat: ArrayLike = ...,
        stiffness: float,
        damping: float = 0.0,
        turn_stiffness: float = 0.0,
        turn_damping: float = 0.0,
    ) -> None: ...

class ActuatorDef:
    """An actuator of a slide, a hinge or a tendon."""

    name: str
    joint: int  # -1: on a tendon
    tendon: int  # -1: on a joint
    kind: str  # motor, position, velocity or general
    gear: float
    kp: float
    kd: float
    force_lower: float
    force_upper: float
    ctrl_lower: float
    ctrl_upper: float
    gain: float
    bias: float
    def __init__(
        self,
        *,
        name: str,
        joint: int = -1,
        tendon: int = -1,
        kind: str,
        gear: float = 1.0,
        kp: float = 0.0,
        kd: float = 0.0,
        force_lower: float = ...,
        force_upper: float = ...,
        ctrl_lower: float = ...,
        ctrl_upper: float = ...,
        gain: float = 1.0,
        bias: float = 0.0,
    ) -> None: ...

class ModelSpec:
    """The definitions of a model. add_* returns an index, and raises ValueError on an inconsistent definition."""

    @property
    def gravity(self) -> Floats: ...  # (3,) [m/s²]
    @gravity.setter
    def gravity(self, value: ArrayLike) -> None: ...
    integrator: str  # bdf1 or bdf2
    step: float  # [s]
    tolerance: float  # of Newton's method
    max_iterations: int
    max_step_iterations: int
    max_halvings: int
    polish: int  # Newton iterations after convergence
    def __init__(self) -> None: ...
    def add_body(self, definition: BodyDef) -> int: ...
    def add_joint(self, definition: JointDef) -> int: ...
    def add_shape(self, definition: ShapeDef) -> int: ...
    def add_points(self, definition: PointsDef) -> int: ...
    def add_contact(self, definition: ContactDef) -> int: ...
    def add_pad(self, definition: PadDef) -> int: ...
    def add_tendon(self, definition: TendonDef) -> int: ...
    def add_coupling(self, definition: CouplingDef) -> int: ...
    def add_loop_closure(self, definition: LoopClosureDef) -> int: ...
    def add_actuator(self, definition: ActuatorDef) -> int: ...
    @property
    def bodies(self) -> list[BodyDef]: ...
    @property
    def joints(self) -> list[JointDef]: ...
    @property
    def shapes(self) -> list[ShapeDef]: ...
    @property
    def points(self) -> list[PointsDef]: ...
    @property
    def contacts(self) -> list[ContactDef]: ...
    @property
    def pads(self) -> list[PadDef]: ...
    @property
    def tendons(self) -> list[TendonDef]: ...
    @property
    def couplings(self) -> list[CouplingDef]: ...
    @property
    def loop_closures(self) -> list[LoopClosureDef]: ...
    @property
    def actuators(self) -> list[ActuatorDef]: ...

class Model:
    """The immutable model of a scene. Raises ValueError where the definitions do not make one."""

    def __init__(self, spec: ModelSpec) -> None: ...
    @property
    def nq(self) -> int: ...
    @property
    def nv(self) -> int: ...
    @property
    def nu(self) -> int: ...
    @property
    def na(self) -> int: ...  # anchors of the elastic friction law
    @property
    def nh(self) -> int: ...  # numbers in the history of BDF2
    @property
    def num_markers(self) -> int: ...
    @property
    def step(self) -> float: ...  # [s]
    @property
    def q0(self) -> list[float]: ...
    @property
    def param_names(self) -> list[str]: ...
    @property
    def param_defaults(self) -> list[float]: ...
    @property
    def body_names(self) -> list[str]: ...
    @property
    def joint_names(self) -> list[str]: ...
    @property
    def contact_names(self) -> list[str]: ...
    @property
    def pad_names(self) -> list[str]: ...
    @property
    def tendon_names(self) -> list[str]: ...
    @property
    def loop_closure_names(self) -> list[str]: ...
    @property
    def actuator_names(self) -> list[str]: ...
    @property
    def joint_q(self) -> list[int]: ...
    @property
    def joint_v(self) -> list[int]: ...
    @property
    def contact_anchors(self) -> list[int]: ...  # first anchor of each contact; -1 under the viscous law
    @property
    def pad_markers(self) -> list[tuple[int, int]]: ...  # first marker and count
    def distance(self, shape: str, points: ArrayLike) -> tuple[Floats, Floats, Floats]: ...

class SiteDef:
    """A named frame on a body."""

    def __init__(self, *, name: str, body: int, pos: ArrayLike, quat: ArrayLike) -> None: ...
    @property
    def name(self) -> str: ...
    @property
    def body(self) -> int: ...  # -1: the world
    @property
    def pos(self) -> Floats: ...  # (3,), in the body frame [m]
    @property
    def quat(self) -> Floats: ...  # (4,)

# Positions q (rows, nq) of N environments, one after the other; params (N, parameters). Poses: (rows, sites, 7).
def site_poses(model: Model, sites: list[SiteDef], params: Floats, q: Floats) -> Floats: ...
def site_poses_vjp(model: Model, sites: list[SiteDef], params: Floats, q: Floats, grad_poses: Floats) -> Floats: ...

_Scalar = TypeVar("_Scalar", np.float64, np.float32)

class TactileReduction:
    """A linear function of the marker forces of a scene."""

    def __init__(self, matrix: ArrayLike) -> None: ...  # (rows, markers, 3)
    @property
    def rows(self) -> int: ...
    @property
    def markers(self) -> int: ...

class TouchStop:
    """The condition that stops environments of a rollout, see gelflow.sim.TouchStop."""

    def __init__(self, *, threshold: ArrayLike, reference_step: int, after_step: int) -> None: ...
    @property
    def threshold(self) -> Floats: ...  # (N,) [N]
    @property
    def reference_step(self) -> int: ...
    @property
    def after_step(self) -> int: ...  # evaluated after this step and all later ones

class Trajectory:
    """The arrays of a rollout, without copies: C-contiguous, time first, then environment.

    A rollout into states of one row, instead of steps + 1, leaves its last state there.
    """

    def __init__(
        self,
        *,
        u: NDArray[np.floating],
        q: NDArray[np.floating],
        v: NDArray[np.floating],
        anchors: NDArray[np.floating],
        anchored: NDArray[np.uint8],
        history: NDArray[np.floating],
        tactile: NDArray[np.floating],
        read_after: NDArray[np.int32],
        halvings: NDArray[np.int8],
        status: NDArray[np.int32],
        active: NDArray[np.uint8],
        stopped_at: NDArray[np.int32],
        reduction: TactileReduction | None = None,
    ) -> None: ...
    @property
    def u(self) -> NDArray[np.floating]: ...  # (steps, N, nu)
    @property
    def q(self) -> NDArray[np.floating]: ...  # (steps + 1, N, nq)
    @property
    def v(self) -> NDArray[np.floating]: ...  # (steps + 1, N, nv)
    @property
    def anchors(self) -> NDArray[np.floating]: ...  # (steps + 1, N, na, 3)
    @property
    def anchored(self) -> NDArray[np.uint8]: ...  # (steps + 1, N, na)
    @property
    def history(self) -> NDArray[np.floating]: ...  # (steps + 1, N, nh)
    @property
    def tactile(self) -> NDArray[np.floating]: ...  # (reads, N, markers, 3), or (reads, N, rows) with a reduction
    @property
    def read_after(self) -> NDArray[np.int32]: ...  # (reads,)
    @property
    def halvings(self) -> NDArray[np.int8]: ...  # (steps, N)
    @property
    def status(self) -> NDArray[np.int32]: ...  # (N,)
    @property
    def active(self) -> NDArray[np.uint8]: ...  # (N,)
    @property
    def stopped_at(self) -> NDArray[np.int32]: ...  # (N,)
    @property
    def reduction(self) -> TactileReduction | None: ...

class TrajectoryCotangent:
    """Gradient of a scalar by the results of a rollout; q, v and tactile are shaped as there."""

    def __init__(
        self,
        *,
        q: NDArray[np.floating],
        v: NDArray[np.floating],
        anchors_end: NDArray[np.floating],
        history_end: NDArray[np.floating],
        tactile: NDArray[np.floating],
    ) -> None: ...
    @property
    def q(self) -> NDArray[np.floating]: ...
    @property
    def v(self) -> NDArray[np.floating]: ...
    @property
    def anchors_end(self) -> NDArray[np.floating]: ...  # (N, na, 3)
    @property
    def history_end(self) -> NDArray[np.floating]: ...  # (N, nh)
    @property
    def tactile(self) -> NDArray[np.floating]: ...

class TrajectoryGradient:
    """Gradient of the scalar by the inputs of the rollout."""

    @property
    def u(self) -> NDArray[np.floating]: ...  # (steps, N, nu)
    @property
    def q(self) -> NDArray[np.floating]: ...  # (N, nq)
    @property
    def v(self) -> NDArray[np.floating]: ...  # (N, nv)
    @property
    def anchors(self) -> NDArray[np.floating]: ...  # (N, na, 3)
    @property
    def history(self) -> NDArray[np.floating]: ...  # (N, nh)
    @property
    def params(self) -> Floats: ...  # (N, parameters), or (N, 0)

class _Batch(Generic[_Scalar]):
    """N environments of a model. The array properties are the batch's own memory."""

    def __init__(self, model: Model, environments: int, threads: int) -> None: ...
    @property
    def environments(self) -> int: ...
    @property
    def threads(self) -> int: ...
    @property
    def checks_params(self) -> bool: ...  # steps and rollouts refuse wrong parameters
    @checks_params.setter
    def checks_params(self, value: bool) -> None: ...
    @property
    def q(self) -> NDArray[_Scalar]: ...  # (N, nq)
    @property
    def v(self) -> NDArray[_Scalar]: ...  # (N, nv)
    @property
    def params(self) -> NDArray[_Scalar]: ...  # (N, parameters)
    @property
    def anchors(self) -> NDArray[_Scalar]: ...  # (N, na, 3)
    @property
    def anchored(self) -> NDArray[np.uint8]: ...  # (N, na)
    @property
    def history(self) -> NDArray[_Scalar]: ...  # (N, nh)
    @property
    def status(self) -> NDArray[np.int32]: ...  # (N,)
    @property
    def iterations(self) -> NDArray[np.int64]: ...  # (N,)
    @property
    def halved(self) -> NDArray[np.int64]: ...  # (N,)
    @property
    def readings(self) -> NDArray[_Scalar]: ...  # (N, markers, 3), read-only, after `update_readings`
    def reset(self, which: NDArray[np.uint8] | None = None) -> None: ...
    def step(self, u: NDArray[_Scalar], steps: int = 1, active: NDArray[np.uint8] | None = None) -> None: ...
    def error_estimate(self, u: NDArray[_Scalar]) -> tuple[NDArray[_Scalar], NDArray[np.int32]]: ...
    def rollout(self, trajectory: Trajectory, stop: TouchStop | None = None) -> None: ...
    def contact_modes(self, trajectory: Trajectory) -> NDArray[np.uint64]: ...  # (steps, N)
    def rollout_vjp(
        self, trajectory: Trajectory, cotangent: TrajectoryCotangent, params: bool = False
    ) -> TrajectoryGradient: ...
    def update_readings(self, active: NDArray[np.uint8] | None = None) -> None: ...
    def tactile(self, out: NDArray[_Scalar], active: NDArray[np.uint8] | None = None) -> None: ...  # (N, markers, 3)
    def reduced_tactile(
        self, reduction: TactileReduction, out: NDArray[_Scalar], active: NDArray[np.uint8] | None = None
    ) -> None: ...  # (N, rows)
    def wrenches(self, out: NDArray[_Scalar]) -> None: ...  # (N, contacts, 6)
    def contact_forces(self, out: NDArray[_Scalar]) -> None: ...  # (N, nv)
    def poses(self, out: NDArray[_Scalar]) -> None: ...  # (N, bodies, 7)
    def mass_matrix(self, out: NDArray[_Scalar]) -> None: ...  # (N, nv, nv)
    def bias(self, out: NDArray[_Scalar]) -> None: ...  # (N, nv)

class Batch(_Batch[np.float64]):
    """In double precision."""

class BatchFloat(_Batch[np.float32]):
    """In single precision."""

class RolloutInput:
    """Initial state, parameters and controls (steps, nu) of one environment, or a direction in their space: then q has
    nv entries, a tangent vector, and `anchored` is unused."""

    def __init__(
        self,
        *,
        params: Floats,
        q: Floats,
        v: Floats,
        anchors: Floats,
        history: Floats,
        u: Floats,
        anchored: NDArray[np.uint8] | None = None,
    ) -> None: ...

class RolloutEnd:
    """State and marker readings at the end of a rollout, or their derivative: then q is a tangent vector (nv,)."""

    @property
    def q(self) -> Floats: ...  # (nq,)
    @property
    def v(self) -> Floats: ...  # (nv,)
    @property
    def anchors(self) -> Floats: ...  # (na * 3,)
    @property
    def tactile(self) -> Floats: ...  # (markers * 3,)

class DirectionalRollout:
    """Result of `directional_rollout`."""

    @property
    def end(self) -> RolloutEnd: ...
    @property
    def derivatives(self) -> list[RolloutEnd]: ...
    @property
    def anchored(self) -> NDArray[np.uint8]: ...
    @property
    def status(self) -> int: ...

def directional_rollout(
    model: Model, start: RolloutInput, directions: Sequence[RolloutInput]
) -> DirectionalRollout: ...

LEVEL: str  # the build in use: base, v3 or sanitize
