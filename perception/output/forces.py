"""Tables and drawings of the forces on the gel."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.perception.force.estimator import ForceEstimate
from gelflow.perception.force.slip import SlipEstimate
from gelflow.perception.output.csv_file import CsvFile

SUFFIX = ".forces.csv"

_COLUMNS = (
    *("frame", "image", "stamp", "contact"),
    *("shear_right_n", "shear_down_n", "normal_n", "moment_n_mm"),
    *("shear_right_sd_n", "shear_down_sd_n", "normal_sd_n", "moment_sd_n_mm"),
    *("centre_right_mm", "centre_down_mm", "contact_area_mm2", "unexplained"),
    *("stick_share", "stick_share_sd", "gross_slip", "gross_slip_confidence", "friction"),
)
_FORCE = (80, 220, 255)
_GROSS_SLIP = (60, 60, 255)
_EDGE = (0, 0, 0)


class ForceTable:
    """Table with one row per image. The cells of an image without an estimate are empty."""

    def __init__(self, path: Path) -> None:
        self._file = CsvFile(path, _COLUMNS)

    def add(
        self, number: int, name: str, stamp: float, force: ForceEstimate | None, slip: SlipEstimate | None = None
    ) -> None:
        """Write the row of one image."""
        first = [number, name, f"{stamp:.6f}"]
        if force is None:
            self._file.write([[*first, *[""] * (len(_COLUMNS) - len(first))]])
        else:
            centre = ["", ""] if force.centre_of_pressure is None else 1e3 * force.centre_of_pressure
            values = [
                *(*force.shear, force.normal, 1e3 * force.moment),
                *(*force.shear_deviation, force.normal_deviation, 1e3 * force.moment_deviation),
                *(*centre, 1e6 * force.contact_area, force.unexplained),
            ]
            cells = [value if isinstance(value, str) else f"{value:.5f}" for value in values]
            self._file.write([[*first, int(force.contact), *cells, *_slip_cells(slip)]])

    def close(self) -> None:
        self._file.close()


def _slip_cells(slip: SlipEstimate | None) -> list[str]:
    if slip is None:
        return [""] * 5
    numbers = (slip.stick_share, slip.stick_share_deviation, slip.confidence, slip.friction)
    share, deviation, confidence, friction = ("" if value is None else f"{value:.4f}" for value in numbers)
    return [share, deviation, str(int(slip.gross)), confidence, friction]


def slip_text(force: ForceEstimate | None, slip: SlipEstimate | None) -> str:
    """The slip of a contact in a few words; empty without a contact."""
    if force is None or slip is None or not force.contact:
        return ""
    if slip.confidence is None:
        return "slip unknown"
    if slip.gross:
        return f"gross slip ({100 * slip.confidence:.0f} %)"
    if slip.stick_share is None or slip.stick_share_deviation is None:
        return "no gross slip, friction unknown"
    return f"sticks {100 * slip.stick_share:.0f} +- {100 * slip.stick_share_deviation:.0f} %"


def force_text(force: ForceEstimate | None) -> str:
    """The forces in one line, ± standard deviations."""
    if force is None:
        return "force unknown: too few markers measured"
    if not force.contact:
        return f"no contact: normal below {3 * force.normal_deviation:.2f} N"
    shear = float(np.linalg.norm(force.shear))
    # Along the shear: exact for the error of the modulus, which is common to both axes, otherwise an upper bound.
    direction = np.abs(force.shear) / shear if shear else np.full(2, 0.5)
    deviation = float(direction @ force.shear_deviation)
    return (
        f"normal {force.normal:.2f} +- {force.normal_deviation:.2f} N, shear {shear:.2f} +- {deviation:.2f} N, "
        f"moment {1e3 * force.moment:.1f} +- {1e3 * force.moment_deviation:.1f} N mm"
    )


def draw_force(
    picture: NDArray[np.uint8],
    force: ForceEstimate | None,
    slip: SlipEstimate | None,
    position: NDArray[np.float64],
) -> None:
    """Draw the forces into an overlay: circles for the normal force of cells, an arrow for the total shear.

    `position` are the markers in the picture [px], shape (markers, 2). The area of a circle is proportional to the
    force, relative to the largest one; the arrow starts at the centre of pressure and has one pitch of length per
    tenth of the ratio of shear to normal force. Both are red in gross slip.
    """
    _caption(picture, ", ".join(filter(None, (force_text(force), slip_text(force, slip)))))
    if force is None or not force.contact:
        return
    colour = _GROSS_SLIP if slip is not None and slip.gross else _FORCE
    pitch = float(np.median(np.linalg.norm(np.diff(position, axis=0), axis=1)))
    share = np.sqrt(force.normal_field / force.normal_field.max())
    for point, radius in zip(position, 0.5 * pitch * share, strict=True):
        if radius > 0.05 * pitch:
            cv2.circle(picture, _rounded(point), max(1, round(radius)), colour, 1, cv2.LINE_AA)
    centre = force.normal_field @ position / force.normal_field.sum()
    tip = centre + 10 * pitch * force.shear / max(force.normal, 1e-9)
    for stroke, thickness in ((_EDGE, 5), (colour, 2)):
        cv2.arrowedLine(picture, _rounded(centre), _rounded(tip), stroke, thickness, cv2.LINE_AA, 0, 0.15)


def _caption(picture: NDArray[np.uint8], text: str) -> None:
    for colour, thickness in ((_EDGE, 3), (_FORCE, 1)):
        corner = (8, picture.shape[0] - 10)
        cv2.putText(picture, text, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, thickness, cv2.LINE_AA)


def _rounded(point: NDArray[np.float64]) -> tuple[int, int]:
    right, down = np.clip(point, -20000, 20000)
    return round(float(right)), round(float(down))
