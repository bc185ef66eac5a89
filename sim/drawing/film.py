"""Drawings of a rollout, and the pictures of a film of them with one camera and one scale."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim.drawing.annotations import force_scales
from gelflow.sim.drawing.renderer import DEFAULT_SIZE, Renderer
from gelflow.sim.drawing.scene_drawing import SceneDrawing, scene_drawing
from gelflow.sim.simulator import Simulator

Array = NDArray[np.float64]

_FRAMED = 50  # drawings of a film that set the camera


def record_rollout(sim: Simulator, controls: Array, frames: Sequence[int]) -> list[SceneDrawing]:
    """Take the steps of `controls` (steps, nu) or (steps, N, nu); draw environment 0 after each number in `frames`.

    The last controls are held when `frames` go beyond them. Raises SimulationError when a step fails.
    """
    if not len(controls):
        raise UsageError("controls must have at least one step, got none")
    drawings, done = [], 0
    for frame in frames:
        while done < frame:
            sim.step(controls[min(done, len(controls) - 1)])
            done += 1
        sim.check()
        drawings.append(scene_drawing(sim))
    return drawings


def film_pictures(
    sim: Simulator,
    drawings: list[SceneDrawing],
    times: Sequence[float],
    *,
    size: tuple[int, int] = DEFAULT_SIZE,
    view: str = "oblique",
) -> Iterator[NDArray[np.uint8]]:
    """A picture (height, width, 3) of each drawing of `sim`, which has the time [s] as title."""
    renderer = Renderer(sim)
    camera = renderer.camera(drawings[:: -(-len(drawings) // _FRAMED)], view, size)
    scales = force_scales(drawings)
    for drawing, time in zip(drawings, times, strict=True):
        yield renderer.draw(drawing, size, camera, scales=scales, title=f"{sim.scene.name}, {time:.2f} s")
