"""Picture of an insertion: gel images, flow maps and the corrections of the policy."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gelflow.figures import draw_flow_map, save

if TYPE_CHECKING:
    from gelflow.perception.frames import CameraMount
    from gelflow.real.runner.insertion.attempt import Attempt, Insertion
    from gelflow.task import InsertionTask

_MAX_ATTEMPTS = 6  # in one picture
_MAGNIFICATION = 5  # of the arrows on the gel images
_SIDES = ("left", "right")


def draw_insertion(insertion: "Insertion", mounts: Sequence["CameraMount"], task: "InsertionTask", path: Path) -> None:
    """Draw one row per attempt: both gel images with marker displacements, both flow maps, and the correction as text.

    At most the last 6 attempts are drawn. Raises UsageError when the picture cannot be written.
    """
    from matplotlib.figure import Figure  # deferred: slow to import

    attempts = [made for made in insertion.attempts if made.reference is not None][-_MAX_ATTEMPTS:]
    if not attempts:
        return
    figure = Figure(figsize=(11.5, 3.1 * len(attempts) + 0.7), layout="constrained")
    count = len(insertion.attempts)
    figure.suptitle(
        f"Part {insertion.number + 1}: {insertion.outcome} after {count} attempt{'s' if count > 1 else ''}", fontsize=13
    )
    axes = figure.subplots(len(attempts), 5, squeeze=False, width_ratios=(1, 1, 1, 1, 1.1))
    for line, made in zip(axes, attempts, strict=True):
        for sensor in (0, 1):
            _gel(line[sensor], made, sensor, mounts[sensor])
            _flow(line[2 + sensor], made, sensor, task)
        line[0].set_ylabel(f"attempt {made.number + 1}", fontsize=10)
        line[4].axis("off")
        line[4].text(0.0, 0.5, _text(made), transform=line[4].transAxes, fontsize=9, va="center")
    figure.supxlabel(
        f"Gel images at the end of the descent, marker displacements × {_MAGNIFICATION}. "
        "Flow maps: longest arrow = 1, fingertip down.",
        fontsize=9,
    )
    save(figure, path, dpi=90)


def _gel(axis: Any, made: "Attempt", sensor: int, mount: "CameraMount") -> None:
    """The last image of the descent with the marker displacements since the reference."""
    from gelflow.perception.frames import decode_image
    from gelflow.perception.tracker import MarkerTracker

    assert made.reference is not None and made.last is not None
    tracker = MarkerTracker(mount.tracker_config())
    tracker.start(decode_image(made.reference.images[sensor].data))
    image = decode_image(made.last.images[sensor].data)
    tracked = tracker.track(image)
    axis.imshow(image[:, :, ::-1])
    (x, y), (right, down) = tracked.position[tracked.valid].T, tracked.displacement[tracked.valid].T
    start = x - right, y - down
    axis.quiver(
        *start,
        _MAGNIFICATION * right,
        _MAGNIFICATION * down,
        color="w",
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.006,
    )
    axis.set(xticks=[], yticks=[])
    axis.set_title(f"{_SIDES[sensor]} camera, displacements × {_MAGNIFICATION}", fontsize=8)


def _flow(axis: Any, made: "Attempt", sensor: int, task: "InsertionTask") -> None:
    """The flow map of one pad at the last frame of the decision."""
    axis.set_title(f"{_SIDES[sensor]} pad, flow map", fontsize=8)
    if made.observation is None:
        axis.axis("off")
        axis.text(0.5, 0.5, "no correction", transform=axis.transAxes, ha="center", va="center", fontsize=9)
        return
    last = len(task.frame_depths) - 1
    maps = made.observation.image.reshape(-1, task.sensors, 2, task.grid.rows * task.grid.cols)
    draw_flow_map(axis, task.grid, maps[last, sensor])


def _text(made: "Attempt") -> str:
    x, y, yaw = made.planar_pose
    lines = [
        f"at x {1e3 * x:+.1f} mm, y {1e3 * y:+.1f} mm, yaw {np.degrees(yaw):+.1f}°",
        f"depth {1e3 * made.depth:.2f} mm, shear {made.shear:.3f} mm",
    ]
    if made.inserted:
        lines += ["", "no contact: in the hole"]
    elif made.correction is not None and made.observation is not None:
        dx, dy, turn = made.correction * (1e3, 1e3, 180 / np.pi)
        lines += [
            "stopped by contact" if made.stopped_by_contact else "not in the hole",
            f"longest flow vector {made.observation.divisor:.3f} {made.observation.unit}",
            "",
            "correction of the policy:",
            f"x {dx:+.2f} mm, y {dy:+.2f} mm",
            f"yaw {turn:+.2f}°",
        ]
    return "\n".join(lines)
