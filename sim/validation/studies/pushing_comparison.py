"""Marker forces of the pushing scene compared with those of DiffRedMax.

The reference file holds a trajectory of DiffRedMax (DiffHand c53b5c4) in its pushing scene, with marker forces. Every
state is set in the scene `pushing` with the viscous law, and the marker forces are compared. Joints (gripper yaw, x,
y; box x, y, z, yaw), markers and force components (shear along rows and columns, compression) have the same order.

One term differs by definition: DiffRedMax uses the velocity of the box at the surface point x − d n, gelflow at the
marker x; the tangential velocities differ by the tangential part of ω × (d n), with ω the angular velocity of the box.
The term is added to the viscous force before Coulomb's bound, so that sticking and slipping markers can be compared.
DiffRedMax treats a marker as slipping when kₜ‖vₜ‖ exceeds µN by 1e-8 N; the comparison does the same.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from gelflow.errors import UsageError
from gelflow.geometry import rotation_matrices
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.simulator import Simulator

Array = NDArray[np.float64]

COMPONENTS = ("shear, rows", "shear, columns", "compression")
STICK_MARGIN = 1e-8  # [N] by which the reference lets the viscous force exceed the bound
UNBOUNDED = 1e9  # a friction coefficient that no marker reaches


@dataclass(frozen=True)
class Reference:
    """States and marker forces of the reference trajectory, at K frames."""

    q: Array  # (K, 7) [m, rad]
    v: Array  # (K, 7) [m/s, rad/s]
    step: NDArray[np.int64]  # (K,): number of steps before the frame
    tactile: Array  # (K, markers, 3) [N]


@dataclass(frozen=True)
class Comparison:
    """Differences to the reference, after adding the velocity term [N]."""

    difference: Array  # (K, markers, 3)
    in_contact: NDArray[np.bool_]  # (K, markers)
    slipping: NDArray[np.bool_]  # (K, markers)
    bound_error: float  # largest deviation of the simulated force from Coulomb's bound on the unbounded force [N]
    largest_term: float  # largest change of a marker force by the velocity term [N]


def load(path: Path) -> Reference:
    """Load a reference trajectory. Raises UsageError for a missing or invalid file."""
    try:
        with np.load(path, allow_pickle=False) as data:
            step = data["tactile_steps"]
            return Reference(
                q=data["q_tight"][step],
                v=data["qdot_tight"][step],
                step=step,
                tactile=data["tactile_tight"],
            )
    except FileNotFoundError:
        raise UsageError(f"{path}: no such file") from None
    except KeyError as error:
        raise UsageError(f"{path}: expected a trajectory with marker forces: {error.args[0]}") from None
    except (OSError, ValueError, TypeError, IndexError):
        raise UsageError(f"{path}: not an .npz file of the reference simulator") from None


def box_distance(points: Array, half: Array) -> tuple[Array, Array]:
    """Signed distance (..., ) and outward normal (..., 3) of points inside a box, or in front of one of its faces."""
    beyond = np.abs(points) - half
    face = beyond.argmax(-1)
    normal = np.eye(3)[face] * np.sign(points)
    return beyond.max(-1), normal


def velocity_term(scene: Scene, sim: Simulator) -> tuple[Array, Array, Array]:
    """Tangential part of ω × (d n) at every marker [m/s] and outward normal, in the marker's axes; distance d [m].

    Computed from the body poses, independent of the simulator's distance functions.
    """
    pad, poses = scene.pads[0], sim.poses()
    shape = next(s for s in scene.shapes if s.name == pad.against[0])
    finger, box = poses[:, pad.body], poses[:, shape.body]
    to_finger, to_box = rotation_matrices(finger[:, 3:]), rotation_matrices(box[:, 3:])
    markers = finger[:, None, :3] + pad.positions @ np.swapaxes(to_finger, 1, 2)
    distance, normal = box_distance((markers - box[:, None, :3]) @ to_box - shape.pose.position, np.asarray(shape.size))
    normal = normal @ np.swapaxes(to_box, 1, 2)
    angular_velocity = np.zeros((len(poses), 1, 3))
    angular_velocity[:, 0, 2] = sim.v[:, scene.v("box_yaw")][:, 0]
    term = np.cross(angular_velocity, distance[..., None] * normal)
    term -= (term * normal).sum(-1, keepdims=True) * normal
    axes = to_finger @ pad.axes[0]  # flat pad: the same for all markers
    return term @ axes, normal @ axes, distance


def bounded(force: Array, normal: Array, mu: float, margin: float) -> tuple[Array, NDArray[np.bool_]]:
    """`force` with its tangential part limited by Coulomb's law, and the mask of slipping markers."""
    pressure = (force * normal).sum(-1, keepdims=True)
    friction = force - pressure * normal
    wanted = np.linalg.norm(friction, axis=-1, keepdims=True)
    slips = wanted > mu * np.abs(pressure) + margin
    ratio = np.where(slips, mu * np.abs(pressure) / np.where(slips, wanted, 1), 1)
    return pressure * normal + ratio * friction, slips[..., 0]


def compare(reference: Reference) -> Comparison:
    """Evaluate the marker forces at every state and compare. Raises UsageError when the scenes differ."""
    scene = load_scene("pushing", friction="viscous")
    pad = scene.pads[0]
    sim = Simulator(scene, num_envs=len(reference.q))
    if reference.q.shape[1:] != (scene.nq,) or reference.tactile.shape[1:] != (scene.num_markers, 3):
        raise UsageError(
            f"expected {scene.nq} positions and {scene.num_markers} markers of 3 forces, as in scene 'pushing', got "
            f"{reference.q.shape[1]} and {reference.tactile.shape[1:]}"
        )
    sim.q[:], sim.v[:] = reference.q, reference.v
    signs = np.array([1.0, 1.0, -1.0])  # the third component is compression: the force on the pad along −z
    forces = sim.tactile() * signs
    mu = sim.param(f"{pad.name}.mu")[0].item()
    sim.param(f"{pad.name}.mu")[:] = UNBOUNDED
    unbounded = sim.tactile() * signs
    term, normal, distance = velocity_term(scene, sim)
    in_contact = distance < 0
    if (forces[~in_contact] != 0).any():
        raise UsageError("a marker outside the box has a nonzero force")
    shift = sim.param(f"{pad.name}.kt")[0] * np.where(in_contact[..., None], term, 0)
    expected, slipping = bounded(unbounded - shift, normal, mu, STICK_MARGIN)
    return Comparison(
        difference=expected * signs - reference.tactile,
        in_contact=in_contact,
        slipping=slipping,
        bound_error=float(np.abs(bounded(unbounded, normal, mu, 0.0)[0] - forces).max()),
        largest_term=float(np.linalg.norm(shift, axis=-1).max()),
    )


def table(reference: Reference, result: Comparison) -> Table:
    """Largest differences of sticking, slipping and contact-free markers."""
    out = Table(title=f"Largest differences over {len(reference.step)} frames [N]")
    for heading in ("markers", "number", *COMPONENTS, "largest force"):
        out.add_column(heading, justify="left" if heading == "markers" else "right")
    groups = {
        "sticking": result.in_contact & ~result.slipping,
        "slipping": result.in_contact & result.slipping,
        "no contact": ~result.in_contact,
    }
    for name, chosen in groups.items():
        worst = np.abs(result.difference[chosen]).max(0, initial=0.0)
        force = np.abs(reference.tactile[chosen]).max(initial=0.0)
        out.add_row(name, str(chosen.sum()), *(f"{value:.1e}" for value in worst), f"{force:.1e}")
    return out
