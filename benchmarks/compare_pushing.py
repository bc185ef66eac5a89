"""Marker forces of the pushing scene against those of DiffRedMax: `python benchmarks/compare_pushing.py FILE.npz`.

The file holds a trajectory of DiffRedMax (DiffHand c53b5c4) in its own pushing scene, and the marker forces that it
read along it. Every state that it read is set in our scene `pushing` under the viscous law, and our markers are read.

Its joints stand in our order (gripper's yaw, x, y; box's x, y, z, yaw), and so do its markers and their axes: shear
along rows, shear along columns, compression. One term differs by definition. It takes the box's velocity at the surface
point x − d n, we take it at the marker x, so that its tangential velocity is larger by the tangential part of
ω × (d n), ω the box's turning. That term is added here to the viscous force, before Coulomb's bound: markers that
stick and markers that slip can both be compared in all components. Its bound lets kₜ‖vₜ‖ exceed µN by 1e-8 N before
it calls a marker slipping, and that is followed too.

Exit status: 0 when all agree within --tolerance, 1 when not, 2 when the file is not such a file.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from gelflow.errors import GelflowError, UsageError
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.simulator import Simulator

Array = NDArray[np.float64]

COMPONENTS = ("shear, rows", "shear, columns", "compression")
STICK_MARGIN = 1e-8  # [N] by which the reference lets the viscous force exceed the bound
UNBOUNDED = 1e9  # a friction coefficient that no marker reaches


@dataclass(frozen=True)
class Reference:
    """What is used of the file: K frames that were read."""

    q: Array  # (K, 7) [m, rad]
    v: Array  # (K, 7) [m/s, rad/s]
    step: NDArray[np.int64]  # (K,): the frame was read after that many steps
    tactile: Array  # (K, markers, 3) [N]


@dataclass(frozen=True)
class Comparison:
    """Differences in N, ours with the one term minus the reference."""

    difference: Array  # (K, markers, 3)
    touching: NDArray[np.bool_]  # (K, markers)
    slipping: NDArray[np.bool_]  # (K, markers)
    own_bound: float  # largest departure of our own reading from Coulomb's bound on our own unbounded force
    largest_term: float  # how much the one term changes a marker's force at most


def load(path: Path) -> Reference:
    """Read the file. Raises UsageError when it is missing or not such a file."""
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
        raise UsageError(f"{path}: expected an .npz file of the reference simulator, got something else") from None


def rotations(quaternions: Array) -> Array:
    """Matrices (..., 3, 3) of unit quaternions w x y z (..., 4)."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def box_distance(points: Array, half: Array) -> tuple[Array, Array]:
    """Signed distance (..., ) and outward normal (..., 3) of points inside a box, or in front of one of its faces."""
    beyond = np.abs(points) - half
    face = beyond.argmax(-1)
    normal = np.eye(3)[face] * np.sign(points)
    return beyond.max(-1), normal


def one_term(scene: Scene, sim: Simulator) -> tuple[Array, Array, Array]:
    """Tangential part of ω × (d n) at every marker, outward normal, both along the marker's axes; and distance [m].

    Computed from the bodies' poses alone, not with the simulator's distances.
    """
    pad, poses = scene.pads[0], sim.poses()
    shape = next(s for s in scene.shapes if s.name == pad.against[0])
    finger, box = poses[:, pad.body], poses[:, shape.body]
    to_finger, to_box = rotations(finger[:, 3:]), rotations(box[:, 3:])
    markers = finger[:, None, :3] + pad.positions @ np.swapaxes(to_finger, 1, 2)
    distance, normal = box_distance((markers - box[:, None, :3]) @ to_box - shape.pose.position, np.asarray(shape.size))
    normal = normal @ np.swapaxes(to_box, 1, 2)
    turning = np.zeros((len(poses), 1, 3))
    turning[:, 0, 2] = sim.v[:, scene.v("box_yaw")][:, 0]
    term = np.cross(turning, distance[..., None] * normal)
    term -= (term * normal).sum(-1, keepdims=True) * normal
    axes = to_finger @ pad.axes[0]  # flat: the same for all markers
    return term @ axes, normal @ axes, distance


def bounded(force: Array, normal: Array, mu: float, margin: float) -> tuple[Array, NDArray[np.bool_]]:
    """Coulomb's bound on the tangential part of `force`, and where it slips."""
    pressure = (force * normal).sum(-1, keepdims=True)
    friction = force - pressure * normal
    wanted = np.linalg.norm(friction, axis=-1, keepdims=True)
    slips = wanted > mu * np.abs(pressure) + margin
    ratio = np.where(slips, mu * np.abs(pressure) / np.where(slips, wanted, 1), 1)
    return pressure * normal + ratio * friction, slips[..., 0]


def compare(reference: Reference) -> Comparison:
    """Set every state, read the markers, add the one term. Raises UsageError when the scenes differ."""
    scene = load_scene("pushing", friction="viscous")
    pad = scene.pads[0]
    sim = Simulator(scene, num_envs=len(reference.q))
    if reference.q.shape[1:] != (scene.nq,) or reference.tactile.shape[1:] != (scene.num_markers, 3):
        raise UsageError(
            f"expected {scene.nq} positions and {scene.num_markers} markers of 3 forces, as in scene 'pushing', got "
            f"{reference.q.shape[1]} and {reference.tactile.shape[1:]}"
        )
    sim.q[:], sim.v[:] = reference.q, reference.v
    signs = np.array([1.0, 1.0, -1.0])  # our third component is compression: the force on the pad along −z
    own = sim.tactile() * signs
    mu = sim.param(f"{pad.name}.mu")[0].item()
    sim.param(f"{pad.name}.mu")[:] = UNBOUNDED
    free = sim.tactile() * signs
    term, normal, distance = one_term(scene, sim)
    touching = distance < 0
    if (own[~touching] != 0).any():
        raise UsageError("a marker off the box shows a force")
    shift = sim.param(f"{pad.name}.kt")[0] * np.where(touching[..., None], term, 0)
    expected, slipping = bounded(free - shift, normal, mu, STICK_MARGIN)
    return Comparison(
        difference=expected * signs - reference.tactile,
        touching=touching,
        slipping=slipping,
        own_bound=float(np.abs(bounded(free, normal, mu, 0.0)[0] - own).max()),
        largest_term=float(np.linalg.norm(shift, axis=-1).max()),
    )


def table(reference: Reference, result: Comparison) -> Table:
    """The largest differences, for the markers that stick, that slip, and that are off the box."""
    out = Table(title=f"Largest differences over {len(reference.step)} frames [N]")
    for heading in ("markers", "number", *COMPONENTS, "largest force"):
        out.add_column(heading, justify="left" if heading == "markers" else "right")
    groups = {
        "sticking": result.touching & ~result.slipping,
        "slipping": result.touching & result.slipping,
        "off the box": ~result.touching,
    }
    for name, chosen in groups.items():
        worst = np.abs(result.difference[chosen]).max(0, initial=0.0)
        force = np.abs(reference.tactile[chosen]).max(initial=0.0)
        out.add_row(name, str(chosen.sum()), *(f"{value:.1e}" for value in worst), f"{force:.1e}")
    return out


def main() -> int:
    parser = argparse.ArgumentParser(description="Marker forces of the pushing scene against DiffRedMax's.")
    parser.add_argument("file", type=Path, help="the trajectory (.npz)")
    parser.add_argument("--tolerance", type=float, default=1e-9, metavar="N", help="largest difference (1e-9 N)")
    args = parser.parse_args()
    try:
        reference = load(args.file)
        result = compare(reference)
    except GelflowError as error:
        print(error, file=sys.stderr)
        return 2
    console = Console()
    console.print(table(reference, result))
    worst = float(np.abs(result.difference).max())
    console.print(f"The one term, tangential part of kₜ ω × (d n), is at most {result.largest_term:.1e} N.")
    console.print(f"Our readings keep Coulomb's bound to {result.own_bound:.1e} N.")
    agree = max(worst, result.own_bound) <= args.tolerance
    console.print(f"Largest difference: {worst:.1e} N; {'agrees' if agree else 'DISAGREES'} to {args.tolerance:g} N.")
    return 0 if agree else 1


if __name__ == "__main__":
    sys.exit(main())
