"""From received bytes and tracked markers to tactile frames: the camera's edge of the observation format."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.errors import PeerError, UsageError
from gelflow.observation import Grid, TactileFrame
from gelflow.perception.calibration import Calibration
from gelflow.perception.tracker import TrackerConfig, TrackingResult

Image = NDArray[np.uint8]

ENCODED = (b"\xff\xd8\xff", b"\x89PNG")  # how the bytes of JPEG and PNG start


@dataclass(frozen=True)
class CameraMount:
    """How a camera looks at its pad, and the grid of markers that is printed there.

    Millimetres come from its `calibration`, or from one scale where perspective and lens don't matter.
    At rotation 0 the finger's tip is at the image's bottom; the rotation is that of the image against this,
    clockwise. Seen from behind (`mirrored`) the pad's y then points to the left, otherwise to the right.
    """

    rows: int = 18  # markers from the finger's base to its tip
    cols: int = 14  # markers across
    pitch: float = 1.4  # distance between neighbouring markers on the gel at rest [mm]
    center: tuple[float, float] = (2.0, 0.0)  # (x, y) of the grid's centre on the pad [mm]
    rotation: Literal[0, 90, 180, 270] = 0  # of the image, clockwise [deg]
    mirrored: bool = True  # the camera sees the gel from behind
    pixels_per_mm: float | None = None  # the same everywhere in the image
    calibration: Calibration | None = None  # exact everywhere; with neither, frames are in px

    def __post_init__(self) -> None:
        if self.rotation not in (0, 90, 180, 270):
            raise UsageError(f"a camera's rotation must be 0, 90, 180 or 270 degrees, got {self.rotation}")
        if self.pixels_per_mm is not None and not 0 < self.pixels_per_mm < float("inf"):
            raise UsageError(f"pixels_per_mm must be positive, got {self.pixels_per_mm}")
        if self.pixels_per_mm is not None and self.calibration is not None:
            raise UsageError("a camera has a calibration or pixels_per_mm, not both")
        self._check_calibration()
        _ = self.grid  # refuses impossible numbers of rows and columns, and pitches

    def _check_calibration(self) -> None:
        c = self.calibration
        if c is not None and (c.rows, c.cols, c.spacing_mm) != (*self.image_grid, self.pitch):
            lines, across = self.image_grid
            raise UsageError(
                f"the calibration is of {c.rows} lines of {c.cols} markers, {c.spacing_mm:g} mm apart; the mount says "
                f"{lines} lines of {across}, {self.pitch:g} mm apart"
            )

    @property
    def grid(self) -> Grid:
        """The printed markers on the pad."""
        return Grid(self.rows, self.cols, self.pitch, self.center)

    @property
    def image_grid(self) -> tuple[int, int]:
        """(lines, markers in a line) of the grid as it lies in the image."""
        return (self.cols, self.rows) if self.rotation in (90, 270) else (self.rows, self.cols)

    def tracker_config(self, *, polarity: Literal["auto", "dark", "bright"] = "auto") -> TrackerConfig:
        """Settings for a tracker that expects this grid, and in this direction."""
        lines, across = self.image_grid
        return TrackerConfig(rows=lines, cols=across, either_way=False, polarity=polarity)

    def order(self) -> NDArray[np.intp]:
        """For each marker of the pad (row by row) its place among the image's (line by line), shape (markers,)."""
        lines, across = self.image_grid
        numbers = np.arange(lines * across).reshape(lines, across)
        turned = np.rot90(numbers, k=self.rotation // 90)  # against the clock: back to the tip at the bottom
        return np.ascontiguousarray(turned[:, ::-1] if self.mirrored else turned).reshape(-1)

    @property
    def unit(self) -> Literal["mm", "px"]:
        """What displacements are known in."""
        return "px" if self.calibration is None and self.pixels_per_mm is None else "mm"

    def displacement_mm(self, tracked: TrackingResult) -> NDArray[np.float64]:
        """Displacements in the image's axes (right, down) [mm], shape (markers, 2). Raises UsageError in "px"."""
        if self.calibration is not None:
            return self.calibration.displacement_mm(tracked.position, tracked.displacement)
        if self.pixels_per_mm is None:
            raise UsageError("this camera's millimetres are not known: give the mount a calibration or pixels_per_mm")
        return tracked.displacement / self.pixels_per_mm

    def to_pad(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Vectors in the image (right, down), shape (n, 2), as (x, y) on the pad, in the same unit."""
        right, down = vectors[:, 0], vectors[:, 1]
        for _ in range(self.rotation // 90):
            right, down = down, -right
        return np.stack([down, -right if self.mirrored else right], axis=1)


def decode_image(data: bytes) -> Image:
    """The image in `data` (JPEG or PNG) as B G R, uint8, shape (height, width, 3).

    Raises PeerError when the bytes are no image. Live and replay both decode here, so that they see the same.
    """
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR) if data else None
    if image is None:
        start = f"are none (they start with {data[:8].hex(' ') or 'nothing'})"
        if data.startswith(ENCODED):
            start = "start like one and can not be decoded: cut off, or damaged"
        raise PeerError(f"expected a JPEG or PNG image, got {len(data)} bytes that {start}")
    return np.asarray(image, dtype=np.uint8)


def tactile_frame(trackeds: Sequence[TrackingResult], mounts: Sequence[CameraMount], stamp: float) -> TactileFrame:
    """What all sensors felt: one tracked image and one mount per sensor, sensor 0 (the left finger) first.

    The unit is "mm" when every mount knows it, otherwise "px". Raises UsageError when the numbers of images
    and mounts differ, the pads have different grids, or a tracked grid is not the mount's.
    """
    if not trackeds or len(trackeds) != len(mounts):
        raise UsageError(f"expected one tracked image per mount, got {len(trackeds)} images and {len(mounts)} mounts")
    if any(mount.grid != mounts[0].grid for mount in mounts):
        raise UsageError("the sensors of one frame must have the same grid of markers")
    unit: Literal["mm", "px"] = "px" if any(mount.unit == "px" for mount in mounts) else "mm"
    grid = mounts[0].grid
    shear = np.zeros((len(mounts), grid.rows * grid.cols, 2), dtype=np.float32)
    valid = np.zeros(shear.shape[:2], dtype=bool)
    for sensor, (tracked, mount) in enumerate(zip(trackeds, mounts, strict=True)):
        if (tracked.rows, tracked.cols) != mount.image_grid:
            lines, across = mount.image_grid
            raise UsageError(
                f"sensor {sensor} shows {tracked.rows} lines of {tracked.cols} markers, its mount "
                f"({mount.rows} × {mount.cols}, turned {mount.rotation}°) expects {lines} lines of {across}"
            )
        order = mount.order()
        valid[sensor] = tracked.valid[order]
        displacement = mount.displacement_mm(tracked) if unit == "mm" else tracked.displacement
        vectors = mount.to_pad(displacement[order])
        shear[sensor] = np.where(valid[sensor, :, None], vectors, np.nan)
    return TactileFrame(shear, valid, grid.positions().astype(np.float32), stamp, unit, grid=grid)
