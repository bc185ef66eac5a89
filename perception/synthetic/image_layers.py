"""Image layers of `AccurateGelRenderer` below and above the dots: illumination, shading, highlights, dust, occluders.

Each function gives one sharp layer in linear light; `blurred` applies the optical blur once to the composed image.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from gelflow.perception.synthetic.appearance import DegradedGelAppearance
from gelflow.perception.synthetic.fast_renderer import illumination

SHARP = 0.5  # standard deviation of edges before the optical blur [px]: about one pixel, which avoids aliasing

_WRINKLE = 0.4  # wavelength of the wrinkles / marker spacing

Layer = NDArray[np.float32]  # shape (height, width), or (height, width, 3) for coloured layers


@dataclass(frozen=True)
class Contact:
    """A contact pressed into the gel."""

    center: tuple[float, float]  # (right, down) in the image [px]
    radius: float  # of the dome in the gel [px]
    depth: float  # 0 (no contact) to 1


def pixel_coordinates(appearance: DegradedGelAppearance) -> tuple[Layer, Layer]:
    """Coordinates (right, down) of each pixel [px], two arrays of shape (height, width)."""
    down, right = np.indices((appearance.height, appearance.width), dtype=np.float32)
    return right, down


def light(appearance: DegradedGelAppearance, rng: np.random.Generator) -> Layer:
    """The gel without markers: coloured illumination with a linear brightness gradient in a random direction."""
    right, down = pixel_coordinates(appearance)
    angle = rng.uniform(0, 2 * np.pi)
    side = np.cos(angle) * (2 * right / appearance.width - 1) + np.sin(angle) * (2 * down / appearance.height - 1)
    return np.asarray(
        illumination(appearance, rng) * (1 + appearance.gradient * side.clip(-1, 1))[..., None], dtype=np.float32
    )


def shading(appearance: DegradedGelAppearance, contact: Contact, angle: float) -> Layer:
    """Brightness factor per channel from the slopes of dome and wrinkles.

    The three lights are 120° apart, the first at `angle` [rad].
    """
    right, down = pixel_coordinates(appearance)
    x, y = (right - contact.center[0]) / contact.radius, (down - contact.center[1]) / contact.radius
    dome = contact.depth * np.exp(-(x * x + y * y) / 2)
    across = math.cos(angle) * y - math.sin(angle) * x
    along = math.cos(angle) * x + math.sin(angle) * y + 0.1 * np.sin(4 * across)
    wrinkles = contact.depth * appearance.ridges * ndtr(8 * (0.9 - np.hypot(x, y)))
    turns = 2 * math.pi * contact.radius / (_WRINKLE * appearance.spacing)
    channels = []
    for k, tint in enumerate((0.1, -0.1, 0.3)):  # pressed gel is closer to the lights, and redder
        turn = angle + k * 2 * math.pi / 3
        slope = 0.9 * (x * math.cos(turn) + y * math.sin(turn))
        fine = 0.22 * np.sin(turns * along + 0.8 * k) if appearance.ridges else 0.0
        channels.append(1 + appearance.shading * dome * (slope + tint) + wrinkles * fine)
    return np.asarray(np.stack(channels, axis=-1), dtype=np.float32)


def shine(appearance: DegradedGelAppearance, contact: Contact, spots: NDArray[np.float64], angle: float) -> Layer:
    """Saturation (0 to 1) of pixels by specular reflection at the rim of the contact and in its highlights.

    `spots`, shape (highlights, 2), are relative to the centre of the contact in units of its radius.
    """
    right, down = pixel_coordinates(appearance)
    x, y = right - contact.center[0], down - contact.center[1]
    total = np.zeros_like(right)
    if appearance.ridges:
        far = np.hypot(x, y)
        lit = np.square(np.maximum((math.cos(angle) * x + math.sin(angle) * y) / (far + 1), 0))
        total = 0.9 * appearance.ridges * lit * np.exp(-np.square((far - contact.radius) / (0.12 * appearance.spacing)))
    for spot in spots:
        reach = np.hypot(x - float(spot[0]) * contact.radius, 1.6 * (y - float(spot[1]) * contact.radius))
        total = np.maximum(total, ndtr((0.35 * appearance.spacing - reach) / 1.5))
    return np.asarray(contact.depth * total, dtype=np.float32)


def dust(appearance: DegradedGelAppearance, rng: np.random.Generator) -> Layer:
    """Transmission (0 to 1) of the dust specks on the lens."""
    right, down = pixel_coordinates(appearance)
    left = np.ones_like(right)
    for _ in range(appearance.dust):
        centre = rng.uniform((0, 0), (appearance.width, appearance.height))
        radius, wide, dark = rng.uniform(1.0, 2.2), rng.uniform(1.0, 1.6), rng.uniform(0.5, 0.8)
        reach = np.hypot((right - centre[0]) / wide, down - centre[1])
        left = left * (1 - dark * ndtr((radius - reach) / SHARP))
    return np.asarray(left, dtype=np.float32)


def occlusion(appearance: DegradedGelAppearance, paths: NDArray[np.float64], progress: float) -> Layer:
    """Opacity (0 to 1) of the occluders, at `progress` (0 to 1) along `paths`."""
    right, down = pixel_coordinates(appearance)
    hidden = np.zeros_like(right)
    for start, end in paths:
        at = start + progress * (end - start)
        x, y = right - float(at[0]), down - float(at[1])
        outline = occluder_radius(appearance) * (1 + 0.15 * np.cos(3 * np.arctan2(y, x) + float(start[0])))
        hidden = np.maximum(hidden, ndtr((outline - np.hypot(x, y)) / SHARP))
    return np.asarray(hidden, dtype=np.float32)


def occluder_radius(appearance: DegradedGelAppearance) -> float:
    """Mean radius of an occluder [px]."""
    return 1.3 * appearance.spacing


def occluder_paths(appearance: DegradedGelAppearance, rng: np.random.Generator) -> NDArray[np.float64]:
    """Start and end of the path of each occluder, both outside the image [px], shape (occluders, 2, 2)."""
    middle = np.array([appearance.width, appearance.height]) / 2
    distance = float(np.linalg.norm(middle)) + 1.3 * occluder_radius(appearance)
    first = rng.uniform(0, 2 * np.pi)
    paths = []
    for k in range(appearance.occluders):
        turn = first + 0.5 * np.pi * k * rng.uniform(0.6, 1.2)
        direction = np.array([np.cos(turn), np.sin(turn)])
        aside = (-1) ** k * rng.uniform(0.2, 0.6) * middle[1]  # paths do not cross at the image centre
        past = middle + aside * np.array([-direction[1], direction[0]])
        paths.append((past - distance * direction, past + distance * direction))
    return np.array(paths).reshape(-1, 2, 2)


def blurred(picture: Layer, appearance: DegradedGelAppearance) -> Layer:
    """`picture` with the optical blur of the appearance; its edges are `SHARP`."""
    width = float(np.sqrt(max(appearance.blur**2 - SHARP**2, 0.0)))
    return picture if width < 0.05 else np.asarray(cv2.GaussianBlur(picture, (0, 0), width), dtype=np.float32)


def noisy(picture: Layer, appearance: DegradedGelAppearance, rng: np.random.Generator) -> Layer:
    """`picture` with sensor and shot noise.

    Three quarters of the variance are common to the channels, as for the colours of one sensor. The independent part
    is scaled so that the grey image has the noise variance of the appearance.
    """
    height, width = picture.shape[:2]
    deviation = np.sqrt(appearance.noise**2 + appearance.shot * picture.mean(axis=-1))
    own = math.sqrt(0.25 / (0.114**2 + 0.587**2 + 0.299**2))  # luminance weights of blue, green and red
    shared = math.sqrt(0.75) * rng.standard_normal((height, width, 1), dtype=np.float32)
    noise = shared + own * rng.standard_normal((height, width, 3), dtype=np.float32)
    return np.asarray(picture + deviation[..., None] * noise, dtype=np.float32)
