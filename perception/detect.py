"""Dots in an image: local contrast, its peaks, and each peak's centre, area and strength below the pixel.

A dot is a spot that differs from its surroundings: contrast is taken against the local mean (a box about as wide as
the dots' spacing, so that illumination gradients drop out) and divided by it (so that dim corners count as much).
Everything is integer or element-wise arithmetic in a fixed order: the same image gives the same numbers.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


PlaneName = Literal["grey", "value", "blue", "green", "red", "chroma"]
PLANES: tuple[PlaneName, ...] = get_args(PlaneName)  # in the order of csrc/image.hpp


@dataclass(frozen=True)
class Look:
    """What makes a dot stand out: the plane of the image that shows it, and whether it is dark or bright there."""

    plane: PlaneName
    bright: bool


# In the order in which they are tried. Grey is what JPEG keeps best. Ink is dark under any colour of light, which is
# what the largest channel ("value") says; paint is bright, or colourful ("chroma": largest minus smallest channel).
DARK = (Look("grey", False), Look("value", False), Look("blue", False))
BRIGHT = (Look("grey", True), Look("chroma", True), Look("red", True), Look("green", True))


@dataclass(frozen=True)
class Dots:
    """Dots found in one image, in the order of the image's lines."""

    centers: NDArray[np.float64]  # (right, down) [px], shape (n, 2)
    areas: NDArray[np.float64]  # [px²], shape (n,)
    peaks: NDArray[np.float64]  # contrast of each, as a share of its surroundings, shape (n,)
    inside: NDArray[np.bool_]  # not cut off by the image's border, shape (n,)

    def __len__(self) -> int:
        return len(self.centers)

    def only(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> "Dots":
        """Some of these dots, by mask or by number."""
        return Dots(self.centers[which], self.areas[which], self.peaks[which], self.inside[which])


def contrast(image: NDArray[np.uint8], look: Look, window: int) -> Floats:
    """How much each pixel stands out of its surroundings, positive in dots, shape (height, width).

    `window` [px]: side of the box that counts as surroundings.
    """
    plane = plane_of(image, look.plane)
    mean = cv2.boxFilter(plane, cv2.CV_32F, (window | 1, window | 1), borderType=cv2.BORDER_REFLECT_101)
    # The 8 keeps the sensor noise of black corners from becoming contrast.
    share = (plane - mean) / (mean + np.float32(8)) if look.bright else (mean - plane) / (mean + np.float32(8))
    return np.asarray(share, dtype=np.float32)


def find_dots(response: Floats, *, radius: float, apart: float, least: float | None = None) -> Dots:
    """Dots of about `radius` [px] that are at least `apart` [px] from each other, in a picture of `contrast`.

    `least` is the smallest contrast that counts; None takes 0.4 of what the strongest thirty have.
    """
    sigma = max(0.6 * radius, 0.8)
    side = 2 * int(np.ceil(1.8 * sigma)) + 1
    smooth = cv2.GaussianBlur(response, (side, side), sigma, borderType=cv2.BORDER_REPLICATE)
    half = max(int(apart), 1)
    highest = cv2.dilate(smooth, np.ones((2 * half + 1, 2 * half + 1), np.uint8))
    floor = 0.02 if least is None else least
    flat = np.flatnonzero((smooth >= highest) & (smooth > floor))
    peaks = smooth.reshape(-1)[flat]
    if least is None and len(peaks):
        keep = peaks > 0.4 * np.median(np.sort(peaks)[-30:])
        flat, peaks = flat[keep], peaks[keep]
    down, right = np.divmod(flat, response.shape[1])
    return _refine(response, right, down, peaks.astype(np.float64), radius, apart)


def _refine(
    response: Floats,
    right: NDArray[np.intp],
    down: NDArray[np.intp],
    peaks: NDArray[np.float64],
    radius: float,
    apart: float,
) -> Dots:
    """Centres and areas, by the weight of the pixels around each peak.

    A pixel weighs 0 below a quarter of the dot's contrast, 1 above three quarters and linearly between: the dot's
    inside may be scratched or shine without moving its centre, and the soft edge carries the sub-pixel part.
    """
    reach = int(np.ceil(min(1.4 * radius + 1.5, max(apart, radius))))
    steps = np.arange(-reach, reach + 1)
    disc = np.hypot(steps[:, None], steps[None, :]) <= reach + 0.3
    step_down, step_right = (a[disc].astype(np.intp) for a in np.meshgrid(steps, steps, indexing="ij"))
    padded = cv2.copyMakeBorder(response, reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=0)
    stride = padded.shape[1]
    places = ((down + reach) * stride + right + reach)[:, None] + (step_down * stride + step_right)
    height = peaks.astype(np.float32)[:, None]
    weight = padded.reshape(-1)[places]
    weight -= 0.25 * height
    weight /= 0.5 * height
    np.clip(weight, 0, 1, out=weight)
    moments = weight.astype(np.float64) @ np.stack([step_right, step_down, np.ones_like(step_down)], axis=1).astype(
        float
    )
    area = moments[:, 2]
    centers = np.stack([right, down], axis=1) + moments[:, :2] / np.maximum(area, 1e-9)[:, None]
    own = np.sqrt(area / np.pi)
    limit = np.array([response.shape[1] - 1, response.shape[0] - 1])
    border = np.minimum(centers, limit - centers).min(axis=1)
    return Dots(centers, area, peaks, border > 0.9 * np.minimum(own, 1.3 * radius))


def plane_of(image: NDArray[np.uint8], name: PlaneName) -> NDArray[np.uint8]:
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


def smaller(image: NDArray[np.uint8], shrink: int) -> NDArray[np.uint8]:
    """`image` with `shrink` × `shrink` pixels averaged into one; what is left over, right and below, is cut off."""
    if shrink == 1:
        return image
    width, height = max(image.shape[1] // shrink, 1), max(image.shape[0] // shrink, 1)
    part = image[: height * shrink, : width * shrink]
    return np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
