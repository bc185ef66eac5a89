"""What lies under and over the dots of a drawn gel: its light, the contact's shading and shine, dust and occluders.

Each function gives one layer in linear light, sharp: the optical blur comes once, over everything.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from gelflow.perception.synthetic.appearance import DegradedGelAppearance
from gelflow.perception.synthetic.fast_renderer import illumination

SHARP = 0.5  # standard deviation of an edge before the optical blur: the pixel's own width and no aliasing [px]

_WRINKLE = 0.4  # from one wrinkle to the next, in spacings

Layer = NDArray[np.float32]  # shape (height, width), or (height, width, 3) where it has colour


@dataclass(frozen=True)
class Contact:
    """What presses into the gel."""

    center: tuple[float, float]  # (right, down) in the image [px]
    radius: float  # of the dome that it makes [px]
    depth: float  # 0 (no contact) to 1


def places(appearance: DegradedGelAppearance) -> tuple[Layer, Layer]:
    """Each pixel's place (right, down) [px]."""
    down, right = np.indices((appearance.height, appearance.width), dtype=np.float32)
    return right, down


def light(appearance: DegradedGelAppearance, rng: np.random.Generator) -> Layer:
    """The gel without markers: coloured lights from the sides, and brighter on one side than on the other."""
    right, down = places(appearance)
    angle = rng.uniform(0, 2 * np.pi)
    side = np.cos(angle) * (2 * right / appearance.width - 1) + np.sin(angle) * (2 * down / appearance.height - 1)
    return np.asarray(
        illumination(appearance, rng) * (1 + appearance.gradient * side.clip(-1, 1))[..., None], dtype=np.float32
    )


def shading(appearance: DegradedGelAppearance, contact: Contact, angle: float) -> Layer:
    """By how much the slopes of dome and wrinkles lighten and darken each channel.

    The three lights stand 120° apart, the first at `angle`.
    """
    right, down = places(appearance)
    x, y = (right - contact.center[0]) / contact.radius, (down - contact.center[1]) / contact.radius
    dome = contact.depth * np.exp(-(x * x + y * y) / 2)
    across = math.cos(angle) * y - math.sin(angle) * x
    along = math.cos(angle) * x + math.sin(angle) * y + 0.1 * np.sin(4 * across)
    wrinkles = contact.depth * appearance.ridges * ndtr(8 * (0.9 - np.hypot(x, y)))
    turns = 2 * math.pi * contact.radius / (_WRINKLE * appearance.spacing)
    channels = []
    for k, tint in enumerate((0.1, -0.1, 0.3)):  # pressed gel is nearer to the lights, and redder
        turn = angle + k * 2 * math.pi / 3
        slope = 0.9 * (x * math.cos(turn) + y * math.sin(turn))
        fine = 0.22 * np.sin(turns * along + 0.8 * k) if appearance.ridges else 0.0
        channels.append(1 + appearance.shading * dome * (slope + tint) + wrinkles * fine)
    return np.asarray(np.stack(channels, axis=-1), dtype=np.float32)


def shine(appearance: DegradedGelAppearance, contact: Contact, spots: NDArray[np.float64], angle: float) -> Layer:
    """How far pixels are saturated by light that the contact's rim and highlights throw back, 0 to 1.

    `spots`, shape (highlights, 2), lie around the contact's centre in units of its radius.
    """
    right, down = places(appearance)
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
    """What the specks leave of the light, 0 to 1."""
    right, down = places(appearance)
    left = np.ones_like(right)
    for _ in range(appearance.dust):
        place = rng.uniform((0, 0), (appearance.width, appearance.height))
        radius, wide, dark = rng.uniform(1.0, 2.2), rng.uniform(1.0, 1.6), rng.uniform(0.5, 0.8)
        reach = np.hypot((right - place[0]) / wide, down - place[1])
        left = left * (1 - dark * ndtr((radius - reach) / SHARP))
    return np.asarray(left, dtype=np.float32)


def occlusion(appearance: DegradedGelAppearance, paths: NDArray[np.float64], progress: float) -> Layer:
    """How far the occluders hide each pixel, 0 to 1, `progress` (0 to 1) of the way from start to end of `paths`."""
    right, down = places(appearance)
    hidden = np.zeros_like(right)
    for start, end in paths:
        at = start + progress * (end - start)
        x, y = right - float(at[0]), down - float(at[1])
        outline = occluder_radius(appearance) * (1 + 0.15 * np.cos(3 * np.arctan2(y, x) + float(start[0])))
        hidden = np.maximum(hidden, ndtr((outline - np.hypot(x, y)) / SHARP))
    return np.asarray(hidden, dtype=np.float32)


def occluder_radius(appearance: DegradedGelAppearance) -> float:
    """Of an occluder, on average [px]."""
    return 1.3 * appearance.spacing


def occluder_paths(appearance: DegradedGelAppearance, rng: np.random.Generator) -> NDArray[np.float64]:
    """Where occluders start and end, both out of sight [px], shape (occluders, 2, 2)."""
    middle = np.array([appearance.width, appearance.height]) / 2
    far = float(np.linalg.norm(middle)) + 1.3 * occluder_radius(appearance)
    first = rng.uniform(0, 2 * np.pi)
    paths = []
    for k in range(appearance.occluders):
        turn = first + 0.5 * np.pi * k * rng.uniform(0.6, 1.2)
        way = np.array([np.cos(turn), np.sin(turn)])
        aside = (-1) ** k * rng.uniform(0.2, 0.6) * middle[1]  # they do not meet in the middle
        past = middle + aside * np.array([-way[1], way[0]])
        paths.append((past - far * way, past + far * way))
    return np.array(paths).reshape(-1, 2, 2)


def blurred(picture: Layer, appearance: DegradedGelAppearance) -> Layer:
    """`picture` through the lens: what was sharp has the appearance's blur."""
    width = float(np.sqrt(max(appearance.blur**2 - SHARP**2, 0.0)))
    return picture if width < 0.05 else np.asarray(cv2.GaussianBlur(picture, (0, 0), width), dtype=np.float32)


def noisy(picture: Layer, appearance: DegradedGelAppearance, rng: np.random.Generator) -> Layer:
    """`picture` with sensor and shot noise, of which the channels share three quarters as one sensor's colours do.

    The rest is each channel's own, as much as makes the grey picture's variance the appearance's.
    """
    height, width = picture.shape[:2]
    deviation = np.sqrt(appearance.noise**2 + appearance.shot * picture.mean(axis=-1))
    own = math.sqrt(0.25 / (0.114**2 + 0.587**2 + 0.299**2))  # weights of blue, green and red in grey
    shared = math.sqrt(0.75) * rng.standard_normal((height, width, 1), dtype=np.float32)
    noise = shared + own * rng.standard_normal((height, width, 3), dtype=np.float32)
    return np.asarray(picture + deviation[..., None] * noise, dtype=np.float32)
