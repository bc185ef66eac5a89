"""Camera images to tactile frames: decoding, the mounting of a camera, and conversion to the pad frame.

`gelflow.observation.flow_map` computes the observation of a policy from these frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.errors import PeerError, UsageError
from gelflow.observation import Grid, TactileFrame
from gelflow.perception.camera_calibration import CameraCalibration
from gelflow.perception.tracker import TrackerConfig, TrackingResult

Image = NDArray[np.uint8]


class UnreadableImage(PeerError):
    """The data of an image cannot be decoded."""


Reduction = Literal[1, 2, 4, 8]  # of the size of an image by its decoder
_DECODING: dict[int, int] = {
    1: cv2.IMREAD_COLOR,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    8: cv2.IMREAD_REDUCED_COLOR_8,
}

_JPEG = b"\xff\xd8\xff"
_PNG = b"\x89PNG"
_LARGEST = 50_000_000  # of an image [pixels]
_BIT_DEPTHS = (8, 10, 12, 14, 16)  # of cameras whose images have 16 bits per value

_SAME_SPACING = 1e-3  # relative difference of two spacings, such as one by a ruler and its rounded value

ENCODED = (_JPEG, _PNG)  # first bytes of JPEG and PNG files


@dataclass(frozen=True)
class CameraMount:
    """Orientation of a camera relative to its pad, the printed grid of markers, and the scale.

    Millimetres come from `calibration`, or from `pixels_per_mm` where perspective and lens distortion are negligible.
    At rotation 0 the fingertip is at the bottom of the image; the pad's y axis points left if `mirrored`, else right;
    `rotation` turns the image clockwise.
    """

    rows: int = 18  # markers from the base to the tip of the finger
    cols: int = 14  # markers across
    pitch: float = 1.4  # marker spacing on the gel at rest [mm]; with a calibration its spacing within 0.1 %
    center: tuple[float, float] = (2.0, 0.0)  # (x, y) of the grid centre on the pad [mm]
    rotation: Literal[0, 90, 180, 270] = 0  # of the image, clockwise [deg]
    mirrored: bool = True  # the camera views the gel from behind
    pixels_per_mm: float | None = None  # uniform scale
    calibration: CameraCalibration | None = None  # position-dependent scale; with neither, frames are in px
    # First and last visible row and column, from 1 at the base of the finger and at the smallest y. None: those of the
    # calibration, without one all.
    visible_rows: tuple[int, int] | None = None
    visible_cols: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        if self.rotation not in (0, 90, 180, 270):
            raise UsageError(f"a camera's rotation must be 0, 90, 180 or 270 degrees, got {self.rotation}")
        if self.pixels_per_mm is not None and not 0 < self.pixels_per_mm < float("inf"):
            raise UsageError(f"pixels_per_mm must be positive, got {self.pixels_per_mm}")
        if self.pixels_per_mm is not None and self.calibration is not None:
            raise UsageError("a camera has a calibration or pixels_per_mm, not both")
        _ = self.grid  # raises UsageError for invalid rows, cols and pitch
        self._check_calibration()
        self._check_visible()

    def _check_calibration(self) -> None:
        c = self.calibration
        if c is None:
            return
        same_spacing = abs(c.spacing_mm - self.pitch) <= _SAME_SPACING * self.pitch
        if c.printed_grid != self.printed_grid or not same_spacing:
            (rows, cols), (fitted_rows, fitted_cols) = self.printed_grid, c.printed_grid
            advice = f"calibrate with --rows {rows} --cols {cols}" if same_spacing else "calibrate again"
            raise UsageError(
                f"the calibration is for {fitted_rows} rows of {fitted_cols} markers with spacing {c.spacing_mm:g} mm; "
                f"the mount has {rows} rows of {cols} with spacing {self.pitch:g} mm: correct the mount, or {advice}"
            )

    def _check_visible(self) -> None:
        for name, lines, printed in (
            ("visible_rows", self.visible_rows, self.rows),
            ("visible_cols", self.visible_cols, self.cols),
        ):
            if lines is None:
                continue
            if len(lines) != 2 or not (lines[0] >= 1 and lines[0] + 2 <= lines[1] <= printed):
                raise UsageError(
                    f"{name} must name the first and the last of at least 3 lines of 1 to {printed}, got {list(lines)}"
                )
        above, below, left, right = self.skipped
        if self.calibration is None and ((above and below) or (left and right)):
            raise UsageError(
                "a grid that extends beyond two opposite borders of the image needs a calibration, which identifies "
                "its lines: gelflow calibrate-camera"
            )

    @property
    def grid(self) -> Grid:
        """The printed grid of markers in the pad frame."""
        return Grid(self.rows, self.cols, self.pitch, self.center)

    @property
    def printed_grid(self) -> tuple[int, int]:
        """(rows, columns) of the printed grid in the orientation of the image."""
        return (self.cols, self.rows) if self.rotation in (90, 270) else (self.rows, self.cols)

    @property
    def image_grid(self) -> tuple[int, int]:
        """(rows, columns) of the visible part of the grid in the image."""
        (rows, cols), (above, below, left, right) = self.printed_grid, self.skipped
        return rows - above - below, cols - left - right

    @property
    def visible_count(self) -> int:
        """Number of markers in the visible part of the grid."""
        rows, cols = self.image_grid
        return rows * cols

    @cached_property
    def skipped(self) -> tuple[int, int, int, int]:
        """Numbers of printed lines that are not visible in the image: above, below, left and right of the others."""
        skipped = (0, 0, 0, 0) if self.calibration is None else self.calibration.skipped
        rows, cols = self.pad_lines(skipped)
        (first_row, last_row), (first_col, last_col) = self.visible_rows or rows, self.visible_cols or cols
        on_pad = np.zeros((self.rows, self.cols), dtype=bool)
        on_pad[first_row - 1 : last_row, first_col - 1 : last_col] = True
        in_image = np.zeros(on_pad.size, dtype=bool)
        in_image[self._printed_order()] = on_pad.reshape(-1)
        return skipped_lines(in_image.reshape(self.printed_grid))

    def pad_lines(self, skipped: tuple[int, int, int, int]) -> tuple[tuple[int, int], tuple[int, int]]:
        """First and last visible row and column on the pad, from 1, where the image does not show `skipped` lines."""
        rows, cols = self.printed_grid
        above, below, left, right = skipped
        in_image = np.zeros((rows, cols), dtype=bool)
        in_image[above : rows - below, left : cols - right] = True
        on_pad = in_image.reshape(-1)[self._printed_order()].reshape(self.rows, self.cols)
        first_row, last_row, first_col, last_col = skipped_lines(on_pad)
        return (first_row + 1, self.rows - last_row), (first_col + 1, self.cols - last_col)

    def tracker_config(self, *, polarity: Literal["auto", "dark", "bright"] = "auto") -> TrackerConfig:
        """Tracker configuration for the visible part of this grid in this orientation."""
        rows, cols = self.image_grid
        anchor = None
        if self.calibration is not None and any(self.skipped):
            above, _, left, _ = self.skipped
            right, down = self.calibration.marker_pixels(above + rows // 2, left + cols // 2).tolist()
            anchor = (right, down)
        return TrackerConfig(
            rows=rows, cols=cols, either_way=False, polarity=polarity, skipped=self.skipped, anchor=anchor
        )

    def marker_order(self) -> NDArray[np.intp]:
        """Index in the image (row by row) of each marker of the pad (row by row), −1 if not visible; shape (markers,).

        The image's markers are those of its visible part, `image_grid`.
        """
        rows, cols = self.printed_grid
        above, below, left, right = self.skipped
        index = np.full((rows, cols), -1, dtype=np.intp)
        part = index[above : rows - below, left : cols - right]
        part[:] = np.arange(part.size).reshape(part.shape)
        return np.asarray(index.reshape(-1)[self._printed_order()])

    def _printed_order(self) -> NDArray[np.intp]:
        """Index in the printed grid as the image shows it (row by row) of each marker of the pad (row by row)."""
        rows, cols = self.printed_grid
        index = np.arange(rows * cols).reshape(rows, cols)
        rotated = np.rot90(index, k=self.rotation // 90)  # counterclockwise: fingertip at the bottom
        return np.ascontiguousarray(rotated[:, ::-1] if self.mirrored else rotated).reshape(-1)

    @property
    def unit(self) -> Literal["mm", "px"]:
        """Unit of the displacements."""
        return "px" if self.calibration is None and self.pixels_per_mm is None else "mm"

    def displacement_mm(self, result: TrackingResult) -> NDArray[np.float64]:
        """Displacements (right, down) [mm], shape (markers, 2), along the axes of the image; with a calibration along
        rows and columns of the grid.

        Raises UsageError when the unit is "px".
        """
        if self.calibration is not None:
            return self.calibration.displacement_mm(result.position, result.displacement)
        if self.pixels_per_mm is None:
            raise UsageError("the scale of this camera is unknown: give the mount a calibration or pixels_per_mm")
        return result.displacement / self.pixels_per_mm

    def to_pad(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Image vectors (right, down), shape (n, 2), as (x, y) in the pad frame, in the same unit."""
        right, down = vectors[:, 0], vectors[:, 1]
        for _ in range(self.rotation // 90):
            right, down = down, -right
        return np.stack([down, -right if self.mirrored else right], axis=1)


def skipped_lines(seen: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    """Lines before the first and after the last row of `seen`, shape (rows, columns), then the same of its columns."""
    counts = []
    for axis in (1, 0):
        lines = np.flatnonzero(seen.any(axis=axis))
        counts += [int(lines[0]), int(seen.shape[1 - axis] - 1 - lines[-1])]
    return counts[0], counts[1], counts[2], counts[3]


class ImageDecoder:
    """Decodes the images of one source.

    Values of 16 bits are reduced to 8 by the bit depth that the first such image uses (8, 10, 12, 14 or 16), because
    cameras of 10 to 14 bits store small numbers. Larger values of later images become white.
    """

    def __init__(self) -> None:
        self._bits = 0  # 0: no image of 16 bits yet

    def __call__(self, data: bytes, *, reduce: Reduction = 1) -> Image:
        """The image B G R, uint8, shape (height, width, 3); see `decode_image`."""
        if reduce not in _DECODING:
            raise UsageError(f"reduce must be 1, 2, 4 or 8, got {reduce!r}")
        if data.startswith(_JPEG):
            return np.asarray(_decoded(data, _DECODING[reduce]), dtype=np.uint8)
        image = _decoded(data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
        if image.dtype == np.uint16:
            self._bits = self._bits or next(bits for bits in _BIT_DEPTHS if image.max() < 1 << bits)
            image = np.minimum(image >> (self._bits - 8), 255)
        return reduce_image(np.asarray(image, dtype=np.uint8), reduce)


def decode_image(data: bytes, *, reduce: Reduction = 1) -> Image:
    """Decodes JPEG or PNG `data` to B G R, uint8, shape (height, width, 3), at 1 / `reduce` of its size, rounded up.

    The JPEG decoder computes the smaller image only, which takes less than half the time at a quarter of the size;
    other images are decoded and then averaged. Values of 16 bits: see `ImageDecoder`.
    The runner and replay both use this function, so that they process identical images. Raises UnreadableImage when
    the bytes are not an image.
    """
    return ImageDecoder()(data, reduce=reduce)


def reduce_image(image: Image, reduce: Reduction) -> Image:
    """`image` at 1 / `reduce` of its size, rounded up, by averaging.

    Sizes that are no multiple of `reduce` are first continued by their last pixels, as JPEG decoders do: a scaling to
    the rounded size would displace markers by up to a pixel.
    """
    if reduce == 1:
        return image
    below, right = (-size % reduce for size in image.shape[:2])
    if below or right:
        image = np.asarray(cv2.copyMakeBorder(image, 0, below, 0, right, cv2.BORDER_REPLICATE), dtype=np.uint8)
    size = (image.shape[1] // reduce, image.shape[0] // reduce)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _decoded(data: bytes, flags: int) -> NDArray[np.uint8 | np.uint16]:
    """The decoded image. Raises UnreadableImage when there is none."""
    height, width = _size_in_header(data)
    if height * width > _LARGEST:  # a damaged size would occupy memory and seconds
        size = f"{width} × {height} pixels"
        raise UnreadableImage(f"the image states a size of {size}: truncated or damaged, or too large")
    image = _decoded_or_none(data, flags)
    if image is not None and image.dtype in (np.uint8, np.uint16):
        return image
    if data.startswith(ENCODED):
        problem = "cannot be decoded: truncated or damaged"
    else:
        if image is None:  # OpenCV does not convert a grey image of floating-point numbers to colours
            image = _decoded_or_none(data, cv2.IMREAD_UNCHANGED)
        if image is not None and image.dtype not in (np.uint8, np.uint16):
            raise UnreadableImage(f"the image has values of type {image.dtype}: convert it to 8 or 16 bits")
        problem = f"do not start like one (first bytes: {data[:8].hex(' ') or 'none'})"
    raise UnreadableImage(f"expected a JPEG or PNG image, got {len(data)} bytes that {problem}")


def _size_in_header(data: bytes) -> tuple[int, int]:
    """Height and width of a JPEG or PNG image without decoding it; zeros when the header has none."""
    if data.startswith(_PNG):
        return int.from_bytes(data[20:24]), int.from_bytes(data[16:20])
    position = 2 if data.startswith(_JPEG) else len(data)
    while position + 9 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # start of frame
            return int.from_bytes(data[position + 5 : position + 7]), int.from_bytes(data[position + 7 : position + 9])
        position += 2 + int.from_bytes(data[position + 2 : position + 4])
    return 0, 0


def _decoded_or_none(data: bytes, flags: int) -> NDArray[Any] | None:
    try:
        return cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags) if data else None
    except cv2.error:  # a damaged header claims more pixels than OpenCV accepts
        return None


def tactile_frame(results: Sequence[TrackingResult], mounts: Sequence[CameraMount], stamp: float) -> TactileFrame:
    """The tactile frame of all sensors: one tracking result and one mount per sensor, sensor 0 (left finger) first.

    The unit is "mm" if every mount has a scale, otherwise "px"; `stamp` is in seconds. Markers outside the visible part
    of a grid are not valid. Raises UsageError when the numbers of results and mounts differ, the pads have different
    grids, or a tracked grid is not that of its mount.
    """
    if not results or len(results) != len(mounts):
        raise UsageError(f"expected one tracking result per mount, got {len(results)} results, {len(mounts)} mounts")
    if any(mount.grid != mounts[0].grid for mount in mounts):
        raise UsageError("the sensors of one frame must have the same grid of markers")
    unit: Literal["mm", "px"] = "px" if any(mount.unit == "px" for mount in mounts) else "mm"
    grid = mounts[0].grid
    shear = np.zeros((len(mounts), grid.rows * grid.cols, 2), dtype=np.float32)
    valid = np.zeros(shear.shape[:2], dtype=bool)
    for sensor, (result, mount) in enumerate(zip(results, mounts, strict=True)):
        if (result.rows, result.cols) != mount.image_grid:
            rows, cols = mount.image_grid
            raise UsageError(
                f"sensor {sensor} shows {result.rows} rows of {result.cols} markers, its mount "
                f"({mount.rows} × {mount.cols}, rotated by {mount.rotation}°) expects {rows} rows of {cols} visible"
            )
        order = mount.marker_order()
        valid[sensor] = (order >= 0) & result.valid[order]
        displacement = mount.displacement_mm(result) if unit == "mm" else result.displacement
        vectors = mount.to_pad(displacement[order])
        shear[sensor] = np.where(valid[sensor, :, None], vectors, np.nan)
    return TactileFrame(shear, valid, grid.positions().astype(np.float32), stamp, unit, grid=grid)
