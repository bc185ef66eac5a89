"""Makes the meshes of the parts that come along: `python -m gelflow.sim.tasks.parts.shipped_meshes`."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gelflow.sim.scene.geometry.mesh import TriangleMesh

Array = NDArray[np.float64]

_WIDTH = 24.0  # of the hexagon across its flats [mm]
# Outline of the connector [mm], counter-clockwise: a plug with two bevelled corners, a key and a notch.
_CONNECTOR = (
    (-14, -9), (8, -9), (14, -5), (14, 9), (6, 9), (6, 6.5), (1, 6.5), (1, 9), (-8, 9), (-11, 6), (-14, 6),
)  # fmt: skip


def prism(outline: Array, height: float) -> TriangleMesh:
    """A closed vertical prism over a simple polygon (n, 2), counter-clockwise; its lower face is at z = 0."""
    count = len(outline)
    vertices = np.concatenate([np.column_stack([outline, np.full(count, z)]) for z in (0.0, height)])
    caps = triangles(outline)
    following = np.roll(np.arange(count), -1)
    here = np.arange(count)
    sides = np.concatenate(
        [
            np.column_stack([here, following, following + count]),
            np.column_stack([here, following + count, here + count]),
        ]
    )
    return TriangleMesh(vertices, np.concatenate([caps[:, ::-1], caps + count, sides]))


def triangles(outline: Array) -> NDArray[np.int64]:
    """Triangles (n − 2, 3) of a simple polygon (n, 2), counter-clockwise: cuts off one ear after the other."""
    left, found = list(range(len(outline))), []
    while len(left) > 3:
        for i in range(len(left)):
            ear = left[i - 1], left[i], left[(i + 1) % len(left)]
            others = outline[[j for j in left if j not in ear]]
            a, b, c = outline[list(ear)]
            turns = [_cross(q - p, others - p) for p, q in ((a, b), (b, c), (c, a))]
            if _cross(b - a, c - a) > 0 and not np.all([turn >= 0 for turn in turns], axis=0).any():
                found.append(ear)
                left.pop(i)
                break
        else:
            raise ValueError("the polygon intersects itself or is clockwise")
    return np.array([*found, left])


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def hexagon() -> TriangleMesh:
    """A hexagonal peg with flats at ±x [mm]."""
    angles = np.radians(30 + 60 * np.arange(6))
    return prism(_WIDTH / np.sqrt(3) * np.column_stack([np.cos(angles), np.sin(angles)]), 60.0)


def connector() -> TriangleMesh:
    """A plug without any symmetry [mm]."""
    return prism(np.array(_CONNECTOR, dtype=float), 60.0)


def obj_text(mesh: TriangleMesh) -> str:
    """A mesh as a Wavefront OBJ file."""
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in mesh.vertices]
    return "\n".join([*lines, *(f"f {a} {b} {c}" for a, b, c in mesh.faces + 1)]) + "\n"


def main() -> None:
    """Write the meshes to the folder of the part files."""
    for name, mesh in (("hexagon", hexagon()), ("connector", connector())):
        (Path(__file__).parent / "shipped" / f"{name}.obj").write_text(obj_text(mesh), encoding="utf-8")


if __name__ == "__main__":
    main()
