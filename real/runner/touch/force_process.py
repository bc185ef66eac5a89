"""Helper process that estimates the forces on the pads.

An estimate takes milliseconds of computing that would delay the runner's threads. `PadForces` is the parent.
"""

import os
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from gelflow.gel.gel_file import ElasticGel
from gelflow.helper_process import connect_to_parent
from gelflow.perception.force.image_forces import GridScale, ImageForces, force_record
from gelflow.session.records import from_plain, to_plain

_NICENESS = 19  # drivers and runner come first


def estimator_settings(gel: ElasticGel, grid: tuple[int, int], scale: GridScale) -> dict[str, Any]:
    """The settings of one pad as plain data; `grid` are the rows and columns of its markers in the image."""
    return {"gel": to_plain(gel), "grid": list(grid), "scale": to_plain(scale)}


def make_estimator(settings: dict[str, Any]) -> ImageForces:
    """The estimator that `estimator_settings` describe. Raises UsageError for a grid without forces."""
    gel = from_plain(ElasticGel, settings["gel"], what="gel")
    rows, cols = settings["grid"]
    return ImageForces(gel, rows, cols, GridScale(**settings["scale"]))


def estimate(estimator: ImageForces, request: dict[str, Any]) -> dict[str, Any] | None:
    """The record of the forces in one image, as plain data; None if too few markers are valid."""
    if "angle" in request:  # the first request after a new rest
        estimator.reset()
        estimator.angle = request["angle"]
    displacement, valid = np.array(request["displacement_mm"], dtype=float), np.array(request["valid"], dtype=bool)
    force = estimator.estimate(displacement, valid, request["stamp"])
    return None if force is None else dict(to_plain(force_record(force, estimator.slip)))


def main(arguments: Sequence[str]) -> int:
    """Entry point: answers every request with one record, until the parent ends."""
    settings, parent, _ = connect_to_parent(arguments)
    os.nice(_NICENESS)
    pads = {int(sensor): make_estimator(values) for sensor, values in settings["pads"].items()}
    while not parent.closed:
        for request in parent.wait():
            parent.send(estimate(pads[request["sensor"]], request))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
