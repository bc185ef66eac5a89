"""Dot detection in the first image: local contrast, its peaks, and sub-pixel centre, area and strength of each dot.

The contrast is the difference from the local mean over a box about as wide as the dot spacing, which removes
illumination gradients, divided by that mean, which normalizes dim regions. The arithmetic has a fixed order, so equal
images give equal results.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


PlaneName = Literal["grey", "value", "blue", "green", "red", "chroma"]
PLANES: tuple[PlaneName, ...] = get_args(PlaneName)  # in the order of Channel in csrc/image.hpp


@dataclass(frozen=True)
class DotAppearance:
    """The image plane with the dots, and whether they are dark or bright in it."""

    plane: PlaneName
    bright: bool


# In the order of the search. JPEG preserves grey best. Ink is dark in the largest channel ("value") under light of any
# colour; paint is bright, or colourful ("chroma": largest minus smallest channel).
DARK = (DotAppearance("grey", False), DotAppearance("value", False), DotAppearance("blue", False))
BRIGHT = (
    DotAppearance("grey", True),
    DotAppearance("chroma", True),
    DotAppearance("red", True),
    DotAppearance("green", True),
)


@dataclass(frozen=True)
class DetectedDots:
    """Dots detected in one image, in the order of the image lines."""

    centers: NDArray[np.float64]  # (right, down) [px], shape (n, 2)
    areas: NDArray[np.float64]  # [px²], shape (n,)
    peaks: NDArray[np.float64]  # relative contrast, shape (n,)
    inside: NDArray[np.bool_]  # not cut by the image border, shape (n,)

    def __len__(self) -> int:
        return len(self.centers)

    def select(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> "DetectedDots":
        """The dots selected by a mask or by indices."""
        return DetectedDots(self.centers[which], self.areas[which], self.peaks[which], self.inside[which])


def local_contrast(image: NDArray[np.uint8], appearance: DotAppearance, window: int) -> Floats:
    """Contrast of each pixel relative to its surroundings, positive in dots, shape (height, width).

    `window` [px] is the side of the box of the local mean.
    """
    plane = image_plane(image, appearance.plane)
    mean = cv2.boxFilter(plane, cv2.CV_32F, (window | 1, window | 1), borderType=cv2.BORDER_REFLECT_101)
    # The offset of 8 grey levels suppresses the sensor noise of black corners.
    share = (plane - mean) / (mean + np.float32(8)) if appearance.bright else (mean - plane) / (mean + np.float32(8))
    return np.asarray(share, dtype=np.float32)


def smooth_response(response: Floats, radius: float) -> Floats:
    """`response` averaged over about a dot of `radius` [px], which suppresses the noise."""
    sigma = max(0.6 * radius, 0.8)
    side = 2 * int(np.ceil(1.8 * sigma)) + 1
    smooth = cv2.GaussianBlur(response, (side, side), sigma, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(smooth, dtype=np.float32)


def detect_dots(
    response: Floats, *, radius: float, min_distance: float, threshold: float | None = None
) -> DetectedDots:
    """Dots of about `radius` [px], at least `min_distance` [px] from each other, in a `local_contrast` response.

    `threshold` is the smallest accepted contrast; None means 0.4 times the median of the thirty strongest peaks.
    """
    smooth = smooth_response(response, radius)
    half = max(int(min_distance), 1)
    highest = cv2.dilate(smooth, np.ones((2 * half + 1, 2 * half + 1), np.uint8))
    minimum = 0.02 if threshold is None else threshold
    flat = np.flatnonzero((smooth >= highest) & (smooth > minimum))
    peaks = smooth.reshape(-1)[flat]
    if threshold is None and len(peaks):
        keep = peaks > 0.4 * np.median(np.sort(peaks)[-30:])
        flat, peaks = flat[keep], peaks[keep]
    down, right = np.divmod(flat, response.shape[1])
    return _refine(response, right, down, peaks.astype(np.float64), radius, min_distance)


def _refine(
    response: Floats,
    right: NDArray[np.intp],
    down: NDArray[np.intp],
    peaks: NDArray[np.float64],
    radius: float,
    min_distance: float,
) -> DetectedDots:
    """Centres and areas from weighted moments of the pixels around each peak.

    The weight rises linearly from 0 to 1 between a quarter and three quarters of the contrast of the dot. It ignores
    scratches and highlights inside a dot, while the soft edge gives the sub-pixel position.
    """
    reach = int(np.ceil(min(1.4 * radius + 1.5, max(min_distance, radius))))
    steps = np.arange(-reach, reach + 1)
    disc = np.hypot(steps[:, None], steps[None, :]) <= reach + 0.3
    step_down, step_right = (a[disc].astype(np.intp) for a in np.meshgrid(steps, steps, indexing="ij"))
    padded = cv2.copyMakeBorder(response, reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=0)
    stride = padded.shape[1]
    pixels = ((down + reach) * stride + right + reach)[:, None] + (step_down * stride + step_right)
    height = peaks.astype(np.float32)[:, None]
    weight = padded.reshape(-1)[pixels]
    weight -= 0.25 * height
    weight /= 0.5 * height
    np.clip(weight, 0, 1, out=weight)
    moments = weight.astype(np.float64) @ np.stack([step_right, step_down, np.ones_like(step_down)], axis=1).astype(
        float
    )
    area = moments[:, 2]
    centers = np.stack([right, down], axis=1) + moments[:, :2] / np.maximum(area, 1e-9)[:, None]
    dot_radius = np.sqrt(area / np.pi)
    limit = np.array([response.shape[1] - 1, response.shape[0] - 1])
    border = np.minimum(centers, limit - centers).min(axis=1)
    return DetectedDots(centers, area, peaks, border > 0.9 * np.minimum(dot_radius, 1.3 * radius))


def image_plane(image: NDArray[np.uint8], name: PlaneName) -> NDArray[np.uint8]:
    """One plane of an image (B G R), shape (height, width)."""
    if name == "grey":
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    blue, green, red = cv2.split(image)
    if name in ("blue", "green", "red"):
        return np.asarray({"blue": blue, "green": green, "red": red}[name], dtype=np.uint8)
    value = cv2.max(cv2.max(blue, green), red)
    if name == "chroma":
        value = cv2.subtract(value, cv2.min(cv2.min(blue, green), red))
    return np.asarray(value, dtype=np.uint8)


def downsample(image: NDArray[np.uint8], shrink: int) -> NDArray[np.uint8]:
    """`image` averaged over blocks of `shrink` × `shrink` pixels; incomplete blocks at the border are dropped."""
    if shrink == 1:
        return image
    width, height = max(image.shape[1] // shrink, 1), max(image.shape[0] // shrink, 1)
    part = image[: height * shrink, : width * shrink]
    return np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
