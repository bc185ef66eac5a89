"""Tracked markers as Foxglove image annotations, which its image panel draws over the camera image."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from numpy.typing import NDArray

MEASURED = (1.0, 1.0, 1.0)  # red, green, blue
INFERRED = (1.0, 0.65, 0.0)
MOTION = (0.3, 0.9, 1.0)


def annotate(values: Mapping[str, Any], nanoseconds: int) -> ImageAnnotations:
    """White points for measured markers, orange ones for inferred markers, lines from the rest positions.

    `values` are the properties of the JSON schema `gelflow.Markers`.
    """
    position = np.asarray(values["position_px"], dtype=float) + 0.5  # Foxglove's origin is the first pixel's corner
    displacement = np.asarray(values["displacement_px"], dtype=float)
    known = np.isfinite(displacement).all(axis=1)
    lines = np.stack([position - displacement, position], axis=1)[known].reshape(-1, 2)
    message = ImageAnnotations()
    message.timestamp.FromNanoseconds(nanoseconds)
    for points, kind, colour, thickness in (
        (lines, PointsAnnotation.LINE_LIST, MOTION, 1.0),
        (position[np.asarray(values["valid"])], PointsAnnotation.POINTS, MEASURED, 2.0),
        (position[np.asarray(values["inferred"])], PointsAnnotation.POINTS, INFERRED, 2.0),
    ):
        _add(message, points, kind, colour, thickness)
    return message


def _add(
    message: ImageAnnotations, points: NDArray[np.float64], kind: int, colour: tuple[float, ...], thickness: float
) -> None:
    part = message.points.add(type=kind, thickness=thickness)
    part.timestamp.CopyFrom(message.timestamp)
    part.outline_color.r, part.outline_color.g, part.outline_color.b = colour
    part.outline_color.a = 1.0
    for right, down in points.tolist():
        part.points.add(x=right, y=down)
