"""The geometry of a part by the kind of its shape."""

from gelflow.part import Part
from gelflow.sim.tasks.parts.geometry import Box, Cylinder, PartGeometry
from gelflow.sim.tasks.parts.mesh_part import MeshPart

_GEOMETRIES: dict[str, type[PartGeometry]] = {"box": Box, "cylinder": Cylinder, "mesh": MeshPart}


def part_geometry(part: Part) -> PartGeometry:
    """The geometry of a part. Raises UsageError when the mesh of the part cannot be read."""
    return _GEOMETRIES[part.shape](part)
